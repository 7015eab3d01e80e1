"""Many runs compared: variants x tasks x seeds, with one tuned knob each."""
