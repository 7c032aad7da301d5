"""Triangle mesh to octree: scan conversion, fill rules, what is inside, thin parts."""
