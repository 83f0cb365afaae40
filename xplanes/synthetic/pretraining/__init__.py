"""Pretraining of small Large Reconstruction Models on procedural objects."""
