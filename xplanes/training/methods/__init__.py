"""Methods: what each family of models adds to a training step."""
