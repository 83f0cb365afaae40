"""Settings of models, losses and samplers beyond X-Planes' own, typed."""
