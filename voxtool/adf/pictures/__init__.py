"""Pictures of distance fields."""
