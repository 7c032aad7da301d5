"""OpenCL: finding a device, building programs, arrays on the device, parallel primitives.

The only package that imports pyopencl. Others hold a `Device`, its `Array`s and its kernels.
"""

from voxtool.opencl.device import Array, Device
from voxtool.opencl.discovery import default_device, list_devices, open_device, shared_device
from voxtool.opencl.driver import THREADS

__all__ = [
    "THREADS",
    "Array",
    "Device",
    "default_device",
    "list_devices",
    "open_device",
    "shared_device",
]
