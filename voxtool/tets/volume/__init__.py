"""The tetrahedral volume as data."""
