"""Questions about images: rendered scenes, and other people's files and data sets."""
