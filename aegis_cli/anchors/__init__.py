"""What a model does on questions, measured once: moments, inputs, curvature and Fisher
information.
"""
