"""Tables, figures and a page that compare runs, made from their records alone."""
