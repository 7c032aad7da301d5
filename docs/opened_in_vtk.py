"""Draws docs/opened_in_vtk.png: the example rabbit's octree as VTK shows it, read from .vtkhdf.

python examples/make_bunny.py -o bunny.obj
voxtool voxelize bunny.obj --dim 64 -o bunny.svo.h5
voxtool export bunny.svo.h5 -o bunny.vtkhdf
python docs/opened_in_vtk.py bunny.vtkhdf docs/opened_in_vtk.png
"""

import sys

import vtk


def draw(path: str, picture: str) -> None:
    """Draw the cells of a HyperTreeGrid."""
    reader = vtk.vtkHDFReader()
    reader.SetFileName(path)
    surface = vtk.vtkHyperTreeGridGeometry()
    surface.SetInputConnection(reader.GetOutputPort())
    mapper = vtk.vtkDataSetMapper()
    mapper.SetInputConnection(surface.GetOutputPort())
    mapper.ScalarVisibilityOff()
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(0.82, 0.63, 0.44)
    actor.GetProperty().EdgeVisibilityOn()
    actor.GetProperty().SetEdgeColor(0.25, 0.2, 0.15)
    renderer = vtk.vtkRenderer()
    renderer.SetBackground(1, 1, 1)
    renderer.AddActor(actor)
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.SetSize(400, 400)
    window.AddRenderer(renderer)
    renderer.GetActiveCamera().Azimuth(30)
    renderer.GetActiveCamera().Elevation(15)
    renderer.ResetCamera()
    window.Render()
    shot = vtk.vtkWindowToImageFilter()
    shot.SetInput(window)
    writer = vtk.vtkPNGWriter()
    writer.SetFileName(picture)
    writer.SetCompressionLevel(9)
    writer.SetInputConnection(shot.GetOutputPort())
    writer.Write()


if __name__ == "__main__":
    draw(*sys.argv[1:])
