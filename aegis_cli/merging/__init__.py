"""A fine-tuned backbone moved back towards the pre-trained one, after its training."""
