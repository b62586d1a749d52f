"""A YAML file whose content knows its lines, and in which no key is given twice."""

from __future__ import annotations

from collections.abc import Sequence

import yaml

Place = Sequence[int | str]
"""The way to a value: names of keys, and numbers in lists."""


class _OnceEach(yaml.SafeLoader):
    """A YAML loader that refuses a duplicate key, of which PyYAML would silently use the last value.

    The loader looks for duplicates before keys are merged (`<<`), because a mapping may override merged keys.
    """

    def compose_mapping_node(self, anchor: dict[object, yaml.Node]) -> yaml.MappingNode:
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for name in (name for name, _ in node.value if isinstance(name, yaml.ScalarNode)):
            if name.value in seen:
                raise yaml.composer.ComposerError(None, None, f"{name.value!r} is given twice", name.start_mark)
            seen.add(name.value)
        return node


class NotYaml(ValueError):
    """The text is not YAML; the message has the line."""


class YamlFile:
    """The content of a YAML file. Raises NotYaml, and RecursionError for a file that is nested too deeply."""

    def __init__(self, text: str) -> None:
        try:
            self._load(text)
        except yaml.MarkedYAMLError as error:
            raise NotYaml(_where_and_why(error)) from error
        except yaml.YAMLError as error:
            raise NotYaml(f"not YAML: {error}") from error

    def _load(self, text: str) -> None:
        loader = _OnceEach(text)
        try:
            self._root = loader.get_single_node()
            self.document: object = None if self._root is None else loader.construct_document(self._root)
        finally:
            loader.dispose()

    def line_of(self, place: Place) -> int:
        """Returns the number of the line, from 1, that a value begins on; that of what it is missing in, where it is
        not there."""
        node, line = self._root, 1
        for part in place:
            if isinstance(node, yaml.MappingNode):
                found = [(key, value) for key, value in node.value if key.value == str(part)]
                if not found:
                    break
                key, node = found[-1]
                line = key.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                line = node.start_mark.line + 1
            else:
                break
        return line


def _where_and_why(error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark
    where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    tab = "; YAML is indented by spaces, never by tabs" if error.problem and "\\t" in error.problem else ""
    return f"{where}not YAML: {error.problem or error.context}{tab}"
