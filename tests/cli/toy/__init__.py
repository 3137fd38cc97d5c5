"""A node type that the package has never heard of; docs/extending.md explains it."""
