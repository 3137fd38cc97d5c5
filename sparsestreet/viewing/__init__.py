"""Looking at a trained street from a browser: rendered here, edited there."""
