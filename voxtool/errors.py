"""What can go wrong: each message is one line that names the thing, the place and the mend."""


class VoxtoolError(Exception):
    """Base of every error that voxtool raises on purpose."""


class MeshError(VoxtoolError):
    """A mesh cannot be read or holds no usable geometry."""


class GridError(VoxtoolError):
    """A grid cannot be placed as asked, or a point lies beyond its fixed-point range."""


class FileError(VoxtoolError):
    """A file is missing, damaged, hostile, or of another kind than expected."""


class DeviceError(VoxtoolError):
    """No OpenCL device can be used, or one failed."""


class MemoryLimitError(VoxtoolError):
    """A request needs more memory than it may take."""
