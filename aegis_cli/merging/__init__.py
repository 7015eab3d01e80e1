"""Move a fine-tuned backbone back towards the pre-trained one after its training."""
