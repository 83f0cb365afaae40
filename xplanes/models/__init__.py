"""X-Planes, the learnt background, and base classes of models and initialisations."""
