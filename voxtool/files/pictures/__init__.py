"""Pictures, animations, pages and transfer functions."""
