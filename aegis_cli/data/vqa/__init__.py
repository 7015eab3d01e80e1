"""Questions about images: rendered scenes, and the files and data sets that others have."""
