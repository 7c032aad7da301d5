"""Images: textures that a device reads through its filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from voxtool.errors import DeviceError, MemoryLimitError
from voxtool.opencl import driver

if TYPE_CHECKING:
    from voxtool.opencl.device import Device

SOURCE = "opencl/images.cl"
FILTER_STEP = 2.0**-9  # an error of a filter's weights: they have 8 bits, rounded to nearest


@dataclass(frozen=True)
class Image:
    """A 3-D image on a device; buffer : the driver's handle."""

    buffer: Any


def image_of(texture: np.ndarray, device: Device) -> Image:
    """Return a 3-D image of one float32 channel for kernels to read.

    texture : (z, y, x) float32

    Raises
    ------
    DeviceError
        If the device has no such images, or none as large.
    MemoryLimitError
        If it has no memory for it.
    """
    cl = driver.opencl()
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    format = cl.ImageFormat(cl.channel_order.R, cl.channel_type.FLOAT)
    _refuse(texture.shape[::-1], format, device)
    try:
        values = np.ascontiguousarray(texture, np.float32)
        shape = texture.shape[::-1]
        image = cl.create_image(device.context, flags, format, shape, hostbuf=values)
    except (cl.Error, MemoryError) as error:
        raise MemoryLimitError(
            f"{device.info.name} could not allocate an image of {texture.nbytes} bytes"
        ) from error
    return Image(image)


def check_filter(device: Device) -> None:
    """Raise DeviceError if the device does not interpolate in images of one float32 channel."""
    image = image_of(np.array([[[0.0, 1.0]]], np.float32), device)
    middle = device.empty(1, np.float32)
    device.kernel(SOURCE, "sample_middle")(1, image=image, middle=middle)
    if abs(float(middle.get()[0]) - 0.5) > FILTER_STEP:
        raise DeviceError(
            f"{device.info.name} does not interpolate in images of one float32 channel: use the "
            "exact sampler, or choose another device"
        )


def _refuse(size: tuple[int, ...], format: Any, device: Device) -> None:
    """Raise DeviceError if the device has no 3-D images of this size and format."""
    cl, name, found = driver.opencl(), device.info.name, device.cl_device
    kinds = cl.mem_flags.READ_ONLY, cl.mem_object_type.IMAGE3D
    if not found.image_support or format not in cl.get_supported_image_formats(
        device.context, *kinds
    ):
        raise DeviceError(
            f"{name} has no 3-D images of one float32 channel: use the exact sampler, or choose "
            "another device"
        )
    most = found.image3d_max_width, found.image3d_max_height, found.image3d_max_depth
    if any(side > limit for side, limit in zip(size, most, strict=True)):
        sides, limits = (" x ".join(map(str, lengths)) for lengths in (size, most))
        raise DeviceError(f"{name} has images of up to {limits} texels, and these are {sides}")
