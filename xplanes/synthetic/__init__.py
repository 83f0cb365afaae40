"""Synthetic scenes, and small LRMs trained on synthetic objects. The core does not import them."""
