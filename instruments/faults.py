"""What faults an emulated device can have, and what an amount of one is."""

from __future__ import annotations

from collections.abc import Collection, Mapping

Amounts = Mapping[str, tuple[float, str]]  # by fault: how much where nothing is said, and its unit


def check_fault(
    whose: str,
    name: str,
    known: Collection[str],
    amounts: Amounts,
    amount: float | None = None,
    near: str = "",
) -> None:
    """Raise ValueError for a fault that isn't ``known``, or for an amount that it can't have.
    ``whose`` begins the message, as "the arm has"; ``near``: what else may be meant.
    """
    if name not in known:
        raise ValueError(f'{whose} no fault "{name}"{near} (there are: {", ".join(known)})')
    if amount is not None and (name not in amounts or amount < 0):
        having = (f'"{fault}" ({usual:g} {unit})' for fault, (usual, unit) in amounts.items())
        what = f'the fault "{name}" has no amount {amount:g}'
        raise ValueError(f"{what}; an amount of 0 or more have: {', '.join(having) or 'none'}")
