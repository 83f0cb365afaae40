"""Tools for captures and runs: inspecting, viewing, exporting, comparing and sharing.

The core does not import them.
"""
