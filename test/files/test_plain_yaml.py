"""YAML from outside: data is read, bombs are refused before they go off."""

from __future__ import annotations

from pathlib import Path

import pytest

from sq_perception.files import plain_yaml


def written(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "some.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_plain_data_is_read(tmp_path):
    text = "width: 640\nk: [1.0, 0, 3]\nroi: {x_offset: 0}\nname: 'a # b'\n"
    assert plain_yaml.read(written(tmp_path, text)) == {
        "width": 640,
        "k": [1.0, 0, 3],
        "roi": {"x_offset": 0},
        "name": "a # b",
    }
    assert plain_yaml.read(written(tmp_path, "")) is None
    assert plain_yaml.read_all(written(tmp_path, "a: 1\n---\nb: 2\n---\n")) == [{"a": 1}, {"b": 2}, None]


BOMB = "a: &a [x, x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "alias"),
        ("a: &a\n  b: *a\n", "alias"),
        ("[" * 33 + "]" * 33, "at most 32 levels"),
        ("[" * 500_000, "at most 32 levels"),
        ("- " * 100_000, "at most 32 levels"),
        ("x: " + "y" * 2**20, "at most 1048576 bytes"),
        ("!!python/object/apply:os.system ['true']", "could not determine a constructor"),
        (b"\xff\xfe\x00", "utf-8"),
        ("a: [", "expected"),
        ("when: 2020-99-99", "month"),
        ("a: 1\n---\nb: 2", "one document"),
    ],
    ids=["bomb", "loop", "deep", "deeper", "lists", "long", "code", "bytes", "cut", "date", "two"],
)
def test_what_is_no_plain_data_is_refused_with_a_reason(tmp_path, text, words):
    with pytest.raises(plain_yaml.YamlError, match=words):
        plain_yaml.read(written(tmp_path, text))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(plain_yaml.YamlError, match="No such file"):
        plain_yaml.read(tmp_path / "none.yaml")
