"""From words to a configuration and its objects."""
