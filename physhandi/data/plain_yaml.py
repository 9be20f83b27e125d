"""YAML as this project reads it: plain data, no field twice, and errors that tell their line."""

from typing import Any

import yaml

_ODD = (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError)


def parse_yaml(text: str) -> Any:
    """Read plain data from YAML text; nothing that it names is imported or called.

    Raises:
        ValueError: If it is not YAML, or a field is there twice; tells the line.
    """
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506 - a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ValueError(f"{where}{error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except _ODD as error:  # What PyYAML raises for a value that does not fit its own tag.
        raise ValueError(f"a value is not what its tag says ({error})") from error


class _Loader(yaml.SafeLoader):
    """Refuses a field that is there twice, of which YAML's own reader keeps the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Check the fields of a mapping, then read it."""
        seen: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"field '{key.value}' is there twice; keep one", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)
