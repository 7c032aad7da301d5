"""What pictures of all content share: rendering, legends, slices."""
