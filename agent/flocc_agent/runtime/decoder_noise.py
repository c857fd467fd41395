"""What the decoders of images print by themselves, kept from the terminal: a damaged picture is told in a sentence."""

import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_NOISE = re.compile(
    rb"(libpng (error|warning)|Corrupt JPEG|Premature end of JPEG|Invalid SOS|TIFF(Read|Open|Fetch)|_TIFF).*"
)
_LOCK = threading.Lock()
"""One thread at a time, since there is one stderr."""


@contextmanager
def quiet_decoders() -> Iterator[None]:
    """Leave out the decoders' own lines on stderr; what else comes meanwhile is passed on."""
    with _LOCK, tempfile.TemporaryFile() as caught:
        sys.stderr.flush()
        try:
            stderr = os.dup(2)
        except OSError:  # closed, as of a daemon: nobody is disturbed
            yield
            return
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            caught.seek(0)
            for line in caught.read().splitlines(keepends=True):
                if not _NOISE.match(line):
                    os.write(2, line)
