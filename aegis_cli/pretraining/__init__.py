"""Training of the embedded models from scratch."""
