"""Streams of classification tasks: images, labels and the words for them."""
