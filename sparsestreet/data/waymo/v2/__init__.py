"""Version 2: a folder of tables (parquet) a component, in it a file a segment."""
