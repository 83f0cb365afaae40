"""One file a method: its field, losses, parameter groups and schedule."""
