"""Reading and writing of small configuration files (YAML, and JSON as its subset), with one-line errors.

Every error is a `ConfigError` of the form ``FILE: FIELD: what is wrong; the fix``.
"""

from torchpose.config.documents import parse_json, parse_mapping
from torchpose.config.examples import example
from torchpose.config.files import (
    MOST_TABLE_BYTES,
    beside,
    check_regular,
    format_list,
    format_number,
    is_inside,
    quoted,
    read_text,
    read_yaml,
    real,
    write_text,
)
from torchpose.config.models import problem_of, shown, suggest, validate, within

__all__ = [
    "MOST_TABLE_BYTES",
    "beside",
    "check_regular",
    "example",
    "format_list",
    "format_number",
    "is_inside",
    "parse_json",
    "parse_mapping",
    "problem_of",
    "quoted",
    "read_text",
    "read_yaml",
    "real",
    "shown",
    "suggest",
    "validate",
    "within",
    "write_text",
]
