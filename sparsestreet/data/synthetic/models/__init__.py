"""Things that stand, drive and walk in the street, built from parts."""
