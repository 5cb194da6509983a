"""Archives as people download them."""

import io
import tarfile
from pathlib import Path


def pack(file: Path, members: dict[str, bytes]) -> Path:
    """A tar.gz of these files."""
    with tarfile.open(file, "w:gz") as archive:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return file
