"""Interactive pages: one HTML file that shows an octree, a distance field or a volume.

`content` says what a page holds of each kind, `page` puts it together with the scripts and shaders
of `assets`, `job` plans it.
"""
