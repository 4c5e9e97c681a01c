"""The parser proof's short form, and that the proof would notice."""

import numpy as np
import pytest

from armctl.dynamixel import packet
from proving import packets


def test_60_000_byte_sequences_break_nothing_and_reach_everything() -> None:
    tally = packets.fuzz(seed=3, shard=0, runs=60_000)
    assert tally.examples == []
    assert (tally.decoder_runs, tally.violations) == (60_000, 0)
    assert tally.packets > 5_000
    assert tally.bad_checksums > 5_000
    assert tally.bus_runs == 60_000 // packets.BUS_EVERY
    assert tally.believed > 50


def test_a_seed_repeats_its_sequences() -> None:
    first, again = (packets.sequences(np.random.default_rng((5, 1))) for _ in range(2))
    assert [next(first) for _ in range(4000)] == [next(again) for _ in range(4000)]


def test_the_proof_notices_a_decoder_that_forgets_between_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forgetful(packet.Decoder):
        def feed(self, data: bytes) -> list[packet.Packet | packet.BadChecksum]:
            self.reset()
            return super().feed(data)

    monkeypatch.setattr(packets, "Decoder", Forgetful)
    tally = packets.fuzz(seed=3, shard=0, runs=300)
    assert tally.violations > 0
    assert "the cut changes the packets" in tally.examples[0]


def test_the_long_form_adds_its_shards_up() -> None:
    result = packets.prove(seed=1, runs=packets.SHARD_RUNS + 10)
    assert (result["runs"], result["violations"]) == (packets.SHARD_RUNS + 10, 0)
