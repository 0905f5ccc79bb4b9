"""Base of pydantic models that are immutable and refuse unknown fields, as almost all of ours."""

import inspect
import re
from typing import Any

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

_ATTRIBUTE = re.compile(r"^    (\w+): (.*(?:\n      +.*)*)", re.MULTILINE)


class FrozenModel(BaseModel):
    """An immutable model without unknown fields; its JSON schema has what its docstring says."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler, /
    ) -> JsonSchemaValue:
        """The schema of pydantic, with attributes of the docstring as descriptions of fields."""
        made = handler(core_schema)
        schema = handler.resolve_ref_schema(made)
        text, described = attribute_docs(cls)
        if described:
            schema["description"] = text
            fields = schema.get("properties", {})
            for name in described.keys() & fields.keys():
                fields[name].setdefault("description", described[name])
        return made


def is_none(value: object) -> bool:
    """For `exclude_if` of fields that are not written where they are unknown."""
    return value is None


def attribute_docs(model: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """Docstring of a model without its attributes, and these by their names on the wire."""
    text, _, section = inspect.cleandoc(model.__doc__ or "").partition("\n\nAttributes:\n")
    aliases = {name: field.alias or name for name, field in model.model_fields.items()}
    return text, {
        aliases.get(name, name): re.sub(r"\s+", " ", said[:1].upper() + said[1:])
        for name, said in _ATTRIBUTE.findall(section)
    }


def example(**fields: Any) -> ConfigDict:  # noqa: ANN401 - JSON
    """Configuration of a model whose JSON schema shows an example with these fields."""
    return ConfigDict(json_schema_extra={"examples": [fields]})


def first_problem(error: ValidationError) -> str:
    """The first field that a file lacks or holds wrongly, with what was found and expected."""
    problem = error.errors(include_url=False)[0]
    where = ".".join(map(str, problem["loc"]))
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "missing":
        message = "got none, expected one"
    elif problem["type"] != "value_error":
        message = f"got {problem['input']!r:.80}, expected: {message}"
    return f"{where}{': ' if where else ''}{message}"
