"""Print the table of checks: `python -m quadvel_sysid.logs.checks`."""

from .table import markdown_table

print(markdown_table())
