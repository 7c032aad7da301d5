"""Merged octrees: equal subtrees stored once, as a directed acyclic graph."""
