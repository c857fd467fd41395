"""A latent that is not what its owner's log says is not kept."""

import asyncio
import hashlib
from types import SimpleNamespace
from typing import Any

import pytest

from flocc_agent.core.effects import FetchLatent
from flocc_agent.core.events import LatentFetched, LatentFetchFailed
from flocc_agent.runtime.jobs import fetch
from flocc_agent.runtime.transport import Fetched, FetchProblem
from flocc_protocol.ids import KeyframeId
from flocc_protocol.records import LatentRecord

KEYFRAME = KeyframeId.parse("r1/3")
LATENT, PICTURE = b"latent", b"picture"


def fetched(served: bytes, named: LatentRecord | None) -> tuple[Any, list[bytes]]:
    kept: list[bytes] = []

    async def fetch_latent(*_: Any, **__: Any) -> Fetched:
        return Fetched(served)

    tools: Any = SimpleNamespace(
        perception=SimpleNamespace(encode_s=lambda: None),
        transport=SimpleNamespace(fetch_latent=fetch_latent),
        workers=SimpleNamespace(stages=SimpleNamespace(observe=lambda *_: None)),
        store=SimpleNamespace(replace_latent=lambda *_: None, put_latent=lambda _, latent: kept.append(latent)),
        clock_s=lambda: 0.0,
    )
    return asyncio.run(fetch(FetchLatent(KEYFRAME, "r2", 1.0, named), tools)), kept


@pytest.mark.parametrize("served", [LATENT, PICTURE])
def test_either_form_that_the_owner_sends_is_taken(served: bytes) -> None:
    both = b"".join(hashlib.sha256(form).digest() for form in (LATENT, PICTURE))
    assert fetched(served, LatentRecord(3, both)) == (LatentFetched(KEYFRAME, "r2"), [served])


def test_another_latent_of_a_relay_is_refused() -> None:
    named = LatentRecord(3, hashlib.sha256(LATENT).digest())
    failed = LatentFetchFailed(KEYFRAME, "r2", FetchProblem.WRONG_HASH.value)
    assert fetched(b"another robot's", named) == (failed, [])


def test_where_no_record_says_so_any_latent_is_taken() -> None:
    assert fetched(LATENT, None)[1] == [LATENT]
