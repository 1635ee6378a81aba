"""Are our sentences as clear as Diffrax's? A reader judges without knowing the source.

    python scripts/sentences.py --seed 0 --folder readings   # a prompt and 80 sentences
    python scripts/sentences.py --folder readings            # count the answers

The script draws 40 sentences at random from our pages and docstrings, and 40 from the
docstrings of the installed Diffrax. It writes them to `sentences.txt`, and whose they
are, the seed and the versions to `key.txt`. Give a reader the first file alone, and
keep what each says as `answers_1.txt` and so on, in lines like `17 clear` and `18
unclear`. The last reading is in `scripts/readings/`.
"""

import argparse
import inspect
import random
import re
import subprocess
import sys
import types
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import diffrax

import delucax


ROOT = Path(__file__).parents[1]
COUNT = 40
# Shorter ones are labels; those that end in a colon introduce what is left out here.
WORDS = range(7, 45)
PROMPT = """\
You are a control engineer who programs in Python, and not a native speaker of English.
Below are 80 sentences, each torn from the documentation of a numerical library. Code is
in backticks. You may assume that the words of the field are known to you, and that the
paragraph around each sentence was there. For each sentence ask yourself: do I
understand at the first reading what it tells me? If you have to read it twice, or
would ask a colleague "what do you mean?", or would never say it so, it is unclear.

Answer with one line for each sentence, its number and one word: `17 clear` or `17
unclear`. Write nothing else.
"""
_BLOCKS = re.compile(r"^( *)```.*?^\1```\s*$", re.DOTALL | re.MULTILINE)
_DISPLAYED = re.compile(r"\$\$.*?\$\$", re.DOTALL)
_LINK = re.compile(r"\[([^\]]+)\](?:\([^)]*\)|\[[^\]]*\])")
_SPECIAL = re.compile(r"^\s*(\||#|!|<|>|\?\?\?|:::|\[\^|---)")
_NEW = re.compile(r"^\s*(?:[-*+]|\d+\.)\s+")
_END = re.compile(r"(?<=[.!?])\s+(?=[A-Z`*])")


def sentences(text: str) -> Iterator[str]:
    """Whole sentences of Markdown, without code, tables and headings."""
    text = _DISPLAYED.sub("\n\n", _BLOCKS.sub("\n\n", text))
    paragraph: list[str] = []
    for line in [*text.splitlines(), ""]:
        is_new = _NEW.match(line)
        if paragraph and (is_new or not line.strip() or _SPECIAL.match(line)):
            whole = _LINK.sub(r"\1", " ".join(paragraph))
            for one in _END.split(" ".join(whole.split())):
                # A citation is not a sentence.
                is_cited = one.startswith(("Source:", "Reference"))
                if one.endswith(".") and len(one.split()) in WORDS and not is_cited:
                    yield one
            paragraph = []
        if line.strip() and not _SPECIAL.match(line):
            paragraph.append(_NEW.sub("", line))


def docstrings(module: types.ModuleType) -> set[str]:
    """Those of the public names of a module and of its public modules."""
    texts, queue, known = set(), [module], set()
    while queue:
        owner = queue.pop()
        if id(owner) in known:
            continue
        known.add(id(owner))
        for name, member in inspect.getmembers(owner):
            if name.startswith("_"):
                continue
            if inspect.ismodule(member):
                if member.__name__.startswith(f"{module.__name__}."):
                    queue.append(member)
            elif getattr(member, "__module__", "").startswith(module.__name__):
                texts.add(inspect.getdoc(member) or "")
    return texts


def ours() -> list[str]:
    """Of the pages, without those that a program writes, and of the docstrings."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    kept = [page for page in pages if "notebooks" not in page.parts]
    texts = [page.read_text(encoding="utf-8") for page in kept]
    return sorted(
        {s for text in [*texts, *docstrings(delucax)] for s in sentences(text)}
    )


def theirs() -> list[str]:
    """Of the docstrings of Diffrax."""
    return sorted({s for text in docstrings(diffrax) for s in sentences(text)})


def drawn(seed: int) -> list[tuple[str, str]]:
    """`(whose, sentence)` for sentences of both, mixed."""
    rng = random.Random(seed)
    mixed = [("ours", s) for s in rng.sample(ours(), COUNT)]
    mixed += [("theirs", s) for s in rng.sample(theirs(), COUNT)]
    rng.shuffle(mixed)
    return mixed


def hidden(sentence: str) -> str:
    """The sentence without the name of its library."""
    return re.sub(r"(?i)delucax|diffrax", "library", sentence)


def write(seed: int, folder: Path) -> None:
    """Draw sentences; write what a reader gets, and the key to it."""
    pairs = drawn(seed)
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{i}. {hidden(s)}" for i, (_, s) in enumerate(pairs, 1)]
    (folder / "sentences.txt").write_text("\n".join([PROMPT, *lines, ""]))
    commit = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=ROOT, text=True)
    made = f"# seed {seed}, commit {commit.strip()}, Diffrax {version('diffrax')}"
    lines = [f"{i} {whose}" for i, (whose, _) in enumerate(pairs, 1)]
    (folder / "key.txt").write_text("\n".join([made, *lines, ""]))


def count(folder: Path) -> None:
    """How many sentences of each side each reader calls clear, and which ones not."""
    text = (folder / "sentences.txt").read_text()
    each = re.findall(r"^\d+\. (.*)$", text, re.M)
    whose = re.findall(r"^\d+ (\w+)$", (folder / "key.txt").read_text(), re.M)
    for path in sorted(folder.glob("answers_*.txt")):
        said = dict(re.findall(r"^(\d+)\W+(clear|unclear)", path.read_text(), re.M))
        if missing := [i for i in range(1, len(whose) + 1) if str(i) not in said]:
            sys.exit(f"{path.name}: no answer to {missing}")
        print(path.name)
        for side in ("ours", "theirs"):
            own = [i for i, of in enumerate(whose, 1) if of == side]
            unclear = [i for i in own if said[str(i)] == "unclear"]
            print(f"{side}: {len(own) - len(unclear)} of {len(own)} are clear")
            print(*(f"  {i}. {each[i - 1]}" for i in unclear), sep="\n")


def main() -> None:
    """Write what a reader gets, or count what the readers said."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True, help="of one reading")
    parser.add_argument("--seed", type=int, help="draw sentences with this seed")
    options = parser.parse_args()
    if options.seed is None:
        count(options.folder)
    else:
        write(options.seed, options.folder)


if __name__ == "__main__":
    main()
