"""Arrays as few bytes: quantizers, entropy coding, and a container that says when a file is damaged."""
