#!/usr/bin/env bash
# From a mesh to a checked octree, its digest, a slice and a NumPy array, through pipes.
#
#     examples/pipeline.sh [MESH [DIM [FOLDER]]]        default: bunny.obj 128 .
#
# Needs the extra `pictures` for the slice.
set -euo pipefail

mesh=${1:-bunny.obj} dim=${2:-128} folder=${3:-.}
name=$(basename "$mesh" .obj)

# one voxelization, kept as HDF5 and checked on its way
voxtool voxelize "$mesh" --dim "$dim" --mode solid -o - |
    tee "$folder/$name.svo.h5" |
    voxtool svo-info - --check

# the same as XML has the same digest: it is that of the content
as_hdf5=$(voxtool svo-info "$folder/$name.svo.h5" --digest)
as_xml=$(voxtool voxelize "$mesh" --dim "$dim" --mode solid -q -o - --format svo.xml.gz |
    voxtool svo-info - --digest)
echo "digest of the HDF5: $as_hdf5"
echo "digest of the XML:  $as_xml"
[[ $as_hdf5 == "$as_xml" ]]

# the thin surface on the same grid, straight into a picture and an array
voxtool voxelize "$mesh" --like "$folder/$name.svo.h5" --mode surface6 -q -o - |
    voxtool export - -o "$folder/$name.surface.npz"
voxtool export "$folder/$name.svo.h5" -o "$folder/$name.png" --slice "z=$((dim * 3 / 10))"
