"""Ticks with something else seen or decided than there was."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from armctl.messages import Fault, TickRecord


def with_outputs(record: TickRecord, **changes: Any) -> TickRecord:
    """The tick with something else decided."""
    return replace(record, outputs=replace(record.outputs, **changes))


def with_sample(record: TickRecord, **changes: Any) -> TickRecord:
    """The tick with something else seen."""
    return replace(record, inputs=replace(record.inputs, sample=replace(record.inputs.sample, **changes)))


def later(record: TickRecord, by_ns: int) -> TickRecord:
    """The tick at a later time, its sample and the servos' stamps with it."""
    sample = record.inputs.sample
    servos = tuple(replace(one, stamp_ns=one.stamp_ns + by_ns if one.stamp_ns else 0) for one in sample.servos)
    sample = replace(sample, time_ns=sample.time_ns + by_ns, servos=servos)
    return replace(record, inputs=replace(record.inputs, now_ns=record.inputs.now_ns + by_ns, sample=sample))


def without_first_joint(record: TickRecord) -> TickRecord:
    """The tick as it is while the first servo has never answered."""
    first, *others = record.outputs.joints
    return with_outputs(record, joints=(replace(first, known=False), *others), tool=None)


def faulty(records: Sequence[TickRecord], first: int, last: int, code: str = "TRIPPED") -> list[TickRecord]:
    """The records with a fault from one tick to another."""
    faults = (Fault(code, "it did", first, 2),)
    return [with_outputs(r, faults=faults) if first <= r.inputs.tick <= last else r for r in records]
