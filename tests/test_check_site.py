"""The check of links beside the site finds those that lead nowhere."""

import importlib.util
from pathlib import Path

from helpers import once


pytestmark = once

ROOT = Path(__file__).parents[1]
_spec = importlib.util.spec_from_file_location(
    "check_site", ROOT / "scripts/check_site.py"
)
assert _spec is not None and _spec.loader is not None
check_site = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_site)

PAGE = """# The `rollout_all` of [Diffrax](https://docs.kidger.site), step by step

## Twice

```sh
# no heading
```

## Twice

## Named { #short }
"""

README = """
[file](page.md), [folder](sub), [mail](https://example.org/none)
[`code`](page.md#the-rollout_all-of-diffrax-step-by-step), [same](#here)
[twice](page.md#twice-1), [twice](page.md#twice-2)
[comment](page.md#no-heading), [named](page.md#short)
![image](gone.png), `[code](gone.md)`

## Here

[there]: gone.md
"""


def test_links_of_a_file_of_the_repository(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "page.md").write_text(PAGE)
    (tmp_path / "README.md").write_text(README)
    assert check_site.broken(tmp_path, "README.md") == [
        "README.md: no heading for page.md#twice-2",
        "README.md: no heading for page.md#no-heading",
        "README.md: no heading for page.md#short",
        "README.md: no file for gone.png",
        "README.md: no file for gone.md",
    ]
