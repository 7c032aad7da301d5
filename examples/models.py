"""Fetch the models that the documentation and the tests use, and check their SHA-256.

    python examples/models.py [-o models] [NAME...]

docs/models.md says where each is from and who may use it. A file that is there already, with the
right sum, is left. Only https is used, also where a server redirects. A file that is longer than
its model, or has another sum, is refused, and nothing is written.
"""

import argparse
import hashlib
import os
import sys
import urllib.request
from pathlib import Path
from typing import NamedTuple

COLLECTION = "https://raw.githubusercontent.com/alecjacobson/common-3d-test-models"
SECONDS = 60  # without a byte, after which a server is given up


class Model(NamedTuple):
    """The bytes and the SHA-256 of a model, and its place in COLLECTION, or ""."""

    size: int
    sha256: str
    place: str


MODELS = {
    "armadillo.obj": Model(
        4_036_311, "c007ebd11e541a2b1ab86a4c376653579281265f2c6c786a4a7bf47ba84d6879",
        "master/data/armadillo.obj",
    ),
    "bluntfin.vtu": Model(
        2_469_502, "79eca5454443e79876add2a55f92d938f270b27fd637d957f1809ad5687b81d2", ""
    ),
    "dragon.obj": Model(
        8_157_055, "8acc3363539e312468276bd2c25d8d5721ef049cc471dd98be23114f2788ed2a", ""
    ),
    "fandisk.obj": Model(
        379_559, "ea5bab2fbf545b1915f0d9faf6cc61ff8c18e0d8174ad61f8e35de15d8f6e3f8",
        "f0f46265301433f4374e80711751a56d1f19f3d4/data/fandisk.obj",
    ),
    "nefertiti.obj": Model(
        3_660_678, "19e39748b145092878cc4faafd050505eb5991c5d3e497be2b4575673fa87968",
        "00e0811c450f5eb4778e69c8756f4ca45bbccd24/data/nefertiti.obj",
    ),
    "rocker-arm.obj": Model(
        665_711, "590257e6d01e689354821d807854306c3bfbb02d9cca73404d5a4924f105c287",
        "b05935cb619f843c96ef50ab45857fab9b281a3a/rocker-arm.obj",
    ),
    "spot.obj": Model(
        330_624, "0738b5e8608fed74e5e8c7aa8dd0af97b4b74f9f6cbf7aac84cd7e40b2e44a75",
        "master/data/spot.obj",
    ),
    "stanford-bunny.obj": Model(
        2_408_417, "1eb35d1e21ce99e5ce911353b6be278990713448dd9e8f5c9387f9de39b32205",
        "29339feae9a77dbd839d0a83f8349c2e7f978c8f/data/stanford-bunny.obj",
    ),
    "suzanne.obj": Model(
        49_137, "d8684326f9bd8cfc24d3d302c1042fa16f63d2e66e49ed56b413fa20bed271e6",
        "master/data/suzanne.obj",
    ),
    "teapot.obj": Model(
        210_614, "1b5396fedd74b577e32cef41146582c2f2e1a050d5b4915193c0ac1ad4187ed4",
        "master/data/teapot.obj",
    ),
}  # fmt: skip


class RefusedError(Exception):
    """Raised if a fetched file has another sum or size than the model."""


def opener() -> urllib.request.OpenerDirector:
    """Return an opener that knows https, and no other scheme."""
    found = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler, urllib.request.HTTPSHandler, urllib.request.UnknownHandler,
        urllib.request.HTTPRedirectHandler, urllib.request.HTTPErrorProcessor,
        urllib.request.HTTPDefaultErrorHandler,
    ):  # fmt: skip
        found.add_handler(handler())
    return found


def fetch(url: str, model: Model, path: Path, opener: urllib.request.OpenerDirector) -> None:
    """Write the model at an address to a file, whole or not at all.

    Raises
    ------
    RefusedError
        If something else is there.
    OSError
        If the address or the file cannot be reached.
    """
    with opener.open(url, timeout=SECONDS) as response:
        data = response.read(model.size + 1)
    if len(data) > model.size:
        raise RefusedError(f"{url} is longer than {model.size:,} bytes")
    if (found := hashlib.sha256(data).hexdigest()) != model.sha256:
        raise RefusedError(f"{url} has SHA-256 {found}, not {model.sha256}")
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_bytes(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def is_there(path: Path, model: Model) -> bool:
    """Return whether a file holds a model."""
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == model.sha256


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(MODELS))
    parser.add_argument("-o", "--output", type=Path, default=Path("models"), metavar="FOLDER")
    given = parser.parse_args(arguments)
    if unknown := set(given.names) - MODELS.keys():
        parser.error(f"no model {', '.join(sorted(unknown))}: choose from {', '.join(MODELS)}")
    given.output.mkdir(parents=True, exist_ok=True)
    missing = 0
    for name in given.names or MODELS:
        model, path = MODELS[name], given.output / name
        try:
            if is_there(path, model):
                print(f"{path}: is there")
                continue
            if not model.place:
                raise RefusedError("no address is known: docs/models.md says what is")
            fetch(f"{COLLECTION}/{model.place}", model, path, opener())
            print(f"{path}: {model.size:,} bytes")
        except (RefusedError, OSError) as error:
            missing += 1
            print(f"{path}: {error}", file=sys.stderr)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
