"""`python scripts/size.py`: how large the library is.

Counts the lines of each package under `src/delucax`: all, and those of code,
docstrings, comments and blanks. `--json` prints them for machines.
"""

import argparse
import ast
import io
import json
import tokenize
from collections import Counter
from pathlib import Path


SOURCE = Path(__file__).parents[1] / "src" / "delucax"


def docstring_lines(tree: ast.Module) -> set[int]:
    """The lines of the docstrings of modules, classes and functions."""
    documented = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    firsts = [n.body[0] for n in ast.walk(tree) if isinstance(n, documented) and n.body]
    return {
        line
        for node in firsts
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }


def count(path: Path) -> Counter[str]:
    """The lines of a file by kind."""
    text = path.read_text()
    documented = docstring_lines(ast.parse(text))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    commented = {
        token.start[0]
        for token in tokens
        if token.type == tokenize.COMMENT and not token.line[: token.start[1]].strip()
    }
    lines = text.splitlines()
    kinds: Counter[str] = Counter(files=1, lines=len(lines))
    for number, line in enumerate(lines, start=1):
        if number in documented:
            kinds["docstrings"] += 1
        elif number in commented:
            kinds["comments"] += 1
        elif line.strip():
            kinds["code"] += 1
        else:
            kinds["blank"] += 1
    return kinds


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rooms: dict[str, Counter[str]] = {}
    for path in sorted(SOURCE.rglob("*.py")):
        room, *rest = path.relative_to(SOURCE).parts
        rooms.setdefault(room if rest else "delucax", Counter()).update(count(path))
    total = sum(rooms.values(), Counter())
    if arguments.json:
        counts = {name: dict(kinds) for name, kinds in rooms.items()}
        print(json.dumps(counts, indent=2))
        return
    columns = "files", "lines", "code", "docstrings", "comments", "blank"
    print(f"{'':14}" + "".join(f"{name:>12}" for name in columns))
    for name, kinds in (*rooms.items(), ("total", total)):
        print(f"{name:14}" + "".join(f"{kinds[column]:>12,}" for column in columns))


if __name__ == "__main__":
    main()
