"""Pictures of views, sheets of pictures and curves of a run, drawn without torch."""
