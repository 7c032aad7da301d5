"""Operations on sets of voxels: booleans, morphology, components, resampling, thinning."""
