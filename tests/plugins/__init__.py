"""What a user may add from outside the package; chosen with plugins=[tests.plugins]."""
