"""What a model does on questions, measured once: moments, inputs, curvature, Fisher information."""
