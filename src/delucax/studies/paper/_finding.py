"""What a study of the paper found."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper, and what was measured.

    - `statement`: the claim, with its limit.
    - `measured`: the number, with its unit.
    - `holds`: whether it came out.
    """

    statement: str
    measured: str
    holds: bool


@dataclass(frozen=True)
class Finding:
    """The claims of one study, its tables (by title, rows as dictionaries) and its
    figures (by file name, those of Matplotlib or paths of images); `notes` say what was
    done and what is not as the paper has it."""

    title: str
    claims: list[Claim]
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    notes: str = ""
