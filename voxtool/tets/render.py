"""Pictures of tetrahedral volumes, by ray casting or by cell projection."""

from __future__ import annotations

from typing import TYPE_CHECKING

from voxtool.choices import METHODS
from voxtool.errors import VoxtoolError
from voxtool.opencl import default_device
from voxtool.tets.integrate import Integral
from voxtool.tets.project import CellProjection
from voxtool.tets.raycast import cast
from voxtool.tets.transfer import default
from voxtool.tets.view import Viewpoint, VisibleCells, VolumeTextures

if TYPE_CHECKING:
    import numpy as np

    from voxtool.camera import Rays
    from voxtool.opencl import Device
    from voxtool.tets.project import Projection
    from voxtool.tets.transfer import LocalTransfer, TransferFunction
    from voxtool.tets.volume import TetVolume


def render_tet(
    volume: TetVolume,
    rays: Rays,
    transfer: TransferFunction | None = None,
    *,
    method: str = "raycast",
    integrator: str = "linear",
    device: Device | None = None,
) -> np.ndarray:
    """The picture of a volume, as VolumeRenderer.render, for a single use; by default through the
    transfer function that shows something of any data."""
    transfer = default(volume) if transfer is None else transfer
    return VolumeRenderer(volume, device).render(rays, transfer, method, integrator)


class VolumeRenderer:
    """A volume on a device, uploaded once and looked at many times."""

    def __init__(self, volume: TetVolume, device: Device | None = None) -> None:
        """Upload the volume's textures.

        Raises
        ------
        DeviceError : there is no device.
        MemoryLimitError : the volume does not fit on it.
        """
        self.volume = volume
        self.device = device or default_device()
        self._textures = VolumeTextures(volume, self.device)
        self._shown: tuple[TransferFunction, LocalTransfer, VisibleCells] | None = None

    def render(
        self,
        rays: Rays,
        transfer: TransferFunction,
        method: str = "raycast",
        integrator: str = "linear",
    ) -> np.ndarray:
        """The picture of rays.

        Parameters
        ----------
        rays : world units.
        transfer : colours and extinctions of scalars, extinctions per world unit.
        method : "raycast" or "projection".
        integrator : "linear", exact for the transfer function; "average", the mean of both ends of
            a cell; "sampled:N", N points in each cell; "preintegrated", from a table.

        Returns
        -------
        (H, W, 4) float32: red, green and blue, premultiplied, and alpha.

        Raises
        ------
        VoxtoolError : an unknown method or integrator.
        MemoryLimitError : the device has no memory for a frame.
        """
        if method not in METHODS:
            raise VoxtoolError(f"method {method!r} is unknown: choose {', '.join(METHODS)}")
        if method == "projection":
            return self.project(rays, transfer, integrator).picture
        visible, integral = self.shown(transfer), self._integral(transfer, integrator)
        return cast(visible, Viewpoint.of(rays, self.volume, self.device), integral)

    def project(
        self, rays: Rays, transfer: TransferFunction, integrator: str = "linear"
    ) -> Projection:
        """What `render` gives by the method "projection", and what it took; raises the same."""
        visible, integral = self.shown(transfer), self._integral(transfer, integrator)
        project = CellProjection(visible, integral)
        return project(Viewpoint.of(rays, self.volume, self.device))

    def shown(self, transfer: TransferFunction) -> VisibleCells:
        """The cells that a transfer function does not leave transparent."""
        return self._show(transfer)[1]

    def _integral(self, transfer: TransferFunction, integrator: str) -> Integral:
        return Integral(self.volume, self._show(transfer)[0], self.device, integrator)

    def _show(self, transfer: TransferFunction) -> tuple[LocalTransfer, VisibleCells]:
        """The transfer function in the volume's frame, and the cells that it shows; kept for the
        next frame."""
        if self._shown is None or self._shown[0] is not transfer:
            local = transfer.local(self.volume)
            self._shown = transfer, local, VisibleCells(self._textures, local)
        return self._shown[1:]
