"""What people do with captures and runs beside training: inspect, view, export, compare, share.

The core does not import it.
"""
