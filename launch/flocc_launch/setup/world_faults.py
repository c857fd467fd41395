"""What the world does to a command (a full disk, a folder of somebody else, an odd locale), as one sentence."""

import errno
import os
import sqlite3
import sys
from contextlib import suppress
from io import TextIOWrapper

from flocc_protocol.errors import FloccError

ADVICE = {
    errno.ENOSPC: "the disk is full; what was written before is kept: free some room, or choose another folder (--out)",
    errno.EDQUOT: "your share of the disk is used up: free some room, or choose another folder (--out)",
    errno.EROFS: "the disk is read-only: choose another folder (--out, FLOCC_CACHE)",
    errno.EACCES: "permission denied: choose a folder of your own (--out, FLOCC_CACHE)",
    errno.EPERM: "permission denied: choose a folder of your own (--out, FLOCC_CACHE)",
    errno.EMFILE: "too many files are open: raise the limit (ulimit -n)",
    errno.ENFILE: "too many files are open on this machine",
}

PASSING = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENFILE, errno.ENOMEM}
"""What may be over by itself, or after somebody made room."""


def speak_utf8() -> None:
    """See that names and messages are UTF-8 whatever the locale says; where it is not, Python is started anew.

    Where it cannot be (its file belongs to somebody else), the command goes on as it is.
    """
    if sys.getfilesystemencoding().lower() != "utf-8" and not sys.flags.utf8_mode:
        os.environ["PYTHONUTF8"] = "1"
        sys.stdout.flush()
        with suppress(OSError):
            os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def may_pass(error: BaseException) -> bool:
    """Whether the same command may succeed later: the disk or the machine was at its end, not the input wrong."""
    return isinstance(error, sqlite3.Error) or (isinstance(error, OSError) and error.errno in PASSING)


def sentence_of(error: BaseException) -> str | None:
    """What a user is told of an error, or None where it is a bug."""
    if isinstance(error, BaseExceptionGroup):
        sentences = [sentence_of(each) for each in error.exceptions]
        return None if None in sentences else next(iter(sentences), None)
    if isinstance(error, FloccError):
        return str(error)
    if isinstance(error, OSError):
        return _os_sentence(error)
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from"):  # pathlib before Python 3.13
        name = str(error).removeprefix("Symlink loop from ").strip("'")
        return f"{name}: is a symbolic link that leads to itself"
    if isinstance(error, UnicodeError):
        return f"a text cannot be read or written: {error}"
    if type(error).__name__ == "PydanticSerializationError" and "UnicodeEncodeError" in str(error):
        return "a name on the command line or in a configuration is not UTF-8: rename that file or folder"
    if isinstance(error, sqlite3.Error):
        return f"a store cannot be used: {error}"
    return None


def _os_sentence(error: OSError) -> str:
    told = ADVICE.get(error.errno or 0) or error.strerror or str(error) or type(error).__name__
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    return f"{' and '.join(names)}: {told}" if names else told
