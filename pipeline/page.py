"""How tables look: as Markdown for GitHub, and as one self-contained HTML page. Every text from a file is escaped."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Sequence
from string import ascii_lowercase
from typing import NamedTuple

from pipeline.cells import Cell, bold, code, markdown, row_of
from pipeline.records import Source
from pipeline.tables import Entry, Head, Row, Table

BEYOND = "†"
TITLE = "Results"
SILENT = 3  # files without a command that are named above a table, at most
LEGEND = (
    "Published numbers are in italics, in columns of their own: the paper's, of its own training on 8 TITAN Xp. They "
    "are never compared with ours.",
    "Ours are upright, each column of one scene, protocol, downscale, field and budget of training: the budget is in "
    "the head, and what was trained for seconds on a processor is no reproduction of the paper.",
    "Ours are means over photos, of the mean over seeds for each photo, with a 95 % bootstrap interval over photos. "
    "How far seeds differ is not in it; a study's own table shows that.",
    "Bold: better than every other row of its column beyond what the photos can tell (paired bootstrap over photos, "
    "95 %). Where the best is tied with another, nothing is bold. Times are not compared.",
    f"{BEYOND} A row that the paper does not have. A number in parentheses: nothing was measured, and the command of "
    "that number below the table would fill the cell. A dash: there is nothing to fill in.",
    "Below each table stands where each of its numbers comes from, by row and by the letters of the columns.",
)


class Trace(NamedTuple):
    """Where some cells come from."""

    cells: dict[str, list[str]]  # row -> letters of columns
    sources: tuple[Source, ...]
    others: tuple[Source, ...]

    def parts(self) -> list[tuple[str, str]]:
        """Rows, and their columns in one text."""
        return [(row, ", ".join(columns)) for row, columns in self.cells.items()]


def letters(heads: Sequence[Head]) -> list[str]:
    """A letter each column of ours; nothing for the others. After z comes aa."""
    made, count = [], 0
    for head in heads:
        if head.kind == "published":
            made.append("")
            continue
        high, low = divmod(count, len(ascii_lowercase))
        made.append((ascii_lowercase[high - 1] if high else "") + ascii_lowercase[low])
        count += 1
    return made


def commands(table: Table) -> list[str]:
    """The commands of a table's empty cells, each once; a cell shows its place in the list, from 1."""
    return list(dict.fromkeys(e.command for row in table.rows for e in row.entries if e.command))


def traces(table: Table) -> list[Trace]:
    """Where each number of ours comes from; cells that come from the same are together."""
    names = letters(table.heads)
    found: dict[tuple[tuple[Source, ...], tuple[Source, ...]], Trace] = {}
    for row in table.rows:
        for entry, name in zip(row.entries, names, strict=True):
            if entry.sources:
                key = entry.sources, entry.others
                trace = found.setdefault(key, Trace({}, *key))
                trace.cells.setdefault(row.label, []).append(name)
    return list(found.values())


def facts(sources: Sequence[Source]) -> list[tuple[str, list[str]]]:
    """What is recorded of some sources: name and values; an empty list is not recorded."""

    def every(values: Sequence[str | None]) -> list[str]:
        return list(dict.fromkeys(value for value in values if value))

    shown = [
        ("file", every([source.file for source in sources])),
        ("run", every([source.run for source in sources])),
        ("command", every([source.command for source in sources])),
        ("commit", every([source.commit for source in sources])),
        ("date", every([source.date for source in sources])),
        ("hardware", every([source.hardware for source in sources])),
        ("settings", every([text for source in sources for text in source.settings])),
        ("note", every([text for source in sources for text in source.notes])),
    ]
    return [(name, values) for name, values in shown if values or name not in ("run", "settings", "note")]


def made_by(table: Table) -> tuple[list[str], list[str]]:
    """The commands that a table's numbers are recorded to be made by, and the files that do not say."""
    sources = [source for row in table.rows for entry in row.entries for source in entry.sources]
    known = dict.fromkeys(source.command for source in sources if source.command)
    return list(known), list(dict.fromkeys(source.file for source in sources if not source.command))


# ------------------------------------------------------------------------------------------------------------ Markdown


def as_markdown(tables: Sequence[Table], command: str) -> str:
    """The page; `command` is what makes it."""
    lines = [f"# {TITLE}", "", "Made from recorded results by", "", "```sh", fenced(command), "```", ""]
    lines += [*(f"- {text}" for text in LEGEND), ""]
    for table in tables:
        lines += [f"## {markdown(table.title)}", "", table.text, "", *shell(table, command), ""]
        lines += [*grid(table), "", *folded(table)]
    return "\n".join(lines).rstrip() + "\n"


def shell(table: Table, command: str) -> list[str]:
    """The commands above a table: what its numbers were made with, as far as it is recorded, and what made it."""
    known, silent = made_by(table)
    unknown = [f"# {file}: its command is not recorded" for file in silent[:SILENT]]
    if len(silent) > SILENT:
        unknown.append(f"# nor is it in {len(silent) - SILENT} more files")
    return ["```sh", *(fenced(text) for text in (*known, *unknown, command)), "```"]


def fenced(text: str) -> str:
    """A line that cannot end its fence."""
    return " ".join(text.split()).replace("```", "'''")


def grid(table: Table) -> list[str]:
    """The table itself."""
    names = letters(table.heads)
    heads = [head_text(head, name) for head, name in zip(table.heads, names, strict=True)]
    lines = [row_of([table.label, *heads]), row_of(["---"] * (1 + len(heads)))]
    listed = commands(table)
    return lines + [
        row_of([markdown(row.label) + mark(row, table), *(cell_text(e, listed) for e in row.entries)])
        for row in table.rows
    ]


def head_text(head: Head, name: str) -> str:
    """A column's head."""
    texts = [markdown(line) for line in head.lines]
    if head.kind == "published":
        return "<br>".join(f"*{text}*" for text in texts)
    return "<br>".join([f"{name}: {texts[0]}", *texts[1:]])


def mark(row: Row, table: Table) -> str:
    """What tells a row that the paper does not have from those that it has, in a table of both."""
    return f" {BEYOND}" if row.beyond and not all(other.beyond for other in table.rows) else ""


def cell_text(entry: Entry, listed: Sequence[str]) -> str:
    """A cell."""
    if entry.command is not None:
        return f"({listed.index(entry.command) + 1})"
    if not entry.lines:
        return "-"
    return "<br>".join(line_text(line, entry.kind) for line in entry.lines)


def line_text(line: Cell, kind: str) -> str:
    """A line of a cell."""
    text = markdown(line.text)
    if kind == "published":
        return text if text == "-" else f"*{text}*"
    return f"<sub>{text}</sub>" if line.small else bold(line._replace(text=text))


def folded(table: Table) -> list[str]:
    """What stands below a table, folded."""
    lines, listed, found = [], commands(table), traces(table)
    if listed:
        lines += ["<details><summary>Commands that fill the empty cells</summary>", ""]
        lines += [*(f"{i}. {code(text)}" for i, text in enumerate(listed, start=1)), "", "</details>", ""]
    if found:
        lines += ["<details><summary>Where the numbers come from</summary>", ""]
        lines += [*(trace_text(trace) for trace in found), "", "</details>", ""]
    return lines


def trace_text(trace: Trace) -> str:
    """Where some cells come from, as an item of a list."""
    others = [f"measured too, not shown: {', '.join(map(code, names(trace.others)))}"] if trace.others else []
    told = [f"{name} {', '.join(map(code, values)) or 'not recorded'}" for name, values in facts(trace.sources)]
    cells = ", ".join(f"**{markdown(row)}** ({columns})" for row, columns in trace.parts())
    return f"- {cells}: {'; '.join([*told, *others])}"


def names(sources: Sequence[Source]) -> list[str]:
    """Files, with the runs in them."""
    return list(dict.fromkeys(s.file + (f" {s.run}" if s.run else "") for s in sources))


# ---------------------------------------------------------------------------------------------------------------- HTML

STYLE = """
:root { color-scheme: light dark; --line: #8885; --soft: #8882; --published: #7a4b00; --page: #fff; }
@media (prefers-color-scheme: dark) { :root { --published: #e8b45c; --page: #16181c; } }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 1500px; padding: 1rem;
  background: var(--page); }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin: 2.5rem 0 .3rem; } p { max-width: 70rem; margin: .3rem 0; }
.scroll { overflow-x: auto; margin: .8rem 0; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .7rem; text-align: left; vertical-align: top; white-space: nowrap; }
thead th { font-weight: 500; font-size: .8rem; line-height: 1.35; border-bottom: 1px solid var(--line); }
tbody tr + tr { border-top: 1px solid var(--line); } tbody th { font-weight: 600; }
tbody th, thead th:first-child { position: sticky; left: 0; z-index: 1; background: var(--page); white-space: normal;
  overflow-wrap: anywhere; min-width: min(13rem, 30vw); border-right: 1px solid var(--line); }
.published { color: var(--published); font-style: italic; } .beyond { font-weight: 500; }
.small, .none { font-size: .78rem; opacity: .75; } .best { font-weight: 800; } .lacking a { font-size: .85rem; }
pre, .scroll, details { max-width: 100%; } pre { overflow-x: auto; background: var(--soft); padding: .5rem .7rem;
  border-radius: 6px; font-size: .8rem; margin: .5rem 0; }
details { margin: .4rem 0; } summary { cursor: pointer; } li { margin: .3rem 0; overflow-wrap: anywhere; }
code { font-size: .85em; }
"""


def as_html(tables: Sequence[Table], command: str) -> str:
    """The page as one HTML file."""
    legend = "".join(f"<li>{html.escape(text)}</li>" for text in LEGEND)
    legend += '<li>So: <span class="published">published</span>, <span class="ours">ours</span>, '
    legend += '<span class="ours best">ours, best</span>.</li>'
    body = "".join(section(number, table, command) for number, table in enumerate(tables, start=1))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Crossray: {TITLE}</title><style>{STYLE}</style></head><body><h1>{TITLE}</h1>"
        f"<p>Made from recorded results by</p><pre>{html.escape(command)}</pre><ul>{legend}</ul>{body}</body></html>\n"
    )


def section(number: int, table: Table, command: str) -> str:
    """A table with all that belongs to it; `number` keeps its links apart from others'."""
    listed = commands(table)
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(table.text))
    above = html.escape("\n".join(shell(table, command)[1:-1]))
    head = "".join(th(head, name) for head, name in zip(table.heads, letters(table.heads), strict=True))
    rows = "".join(tr(row, table, listed, number) for row in table.rows)
    grid = f"<table><thead><tr><th>{html.escape(table.label)}</th>{head}</tr></thead><tbody>{rows}</tbody></table>"
    items = [f'<li id="c{number}-{i}"><code>{html.escape(c)}</code></li>' for i, c in enumerate(listed, start=1)]
    below = fold("Commands that fill the empty cells", "ol", items)
    below += fold("Where the numbers come from", "ul", [trace_html(trace) for trace in traces(table)])
    return (
        f"<h2>{html.escape(table.title)}</h2><p>{text}</p><pre>{above}</pre>"
        f'<div class="scroll" tabindex="0">{grid}</div>{below}'
    )


def fold(title: str, kind: str, items: Sequence[str]) -> str:
    """A list that opens on a click; nothing where it is empty."""
    return f"<details><summary>{title}</summary><{kind}>{''.join(items)}</{kind}></details>" if items else ""


def th(head: Head, name: str) -> str:
    """A column's head."""
    lines = [html.escape(line) for line in head.lines]
    if name:
        lines[0] = f"{name}: {lines[0]}"
    return f'<th scope="col" class="{head.kind}">{"<br>".join(lines)}</th>'


def tr(row: Row, table: Table, listed: Sequence[str], number: int) -> str:
    """A row."""
    label = html.escape(row.label) + mark(row, table)
    cells = "".join(td(entry, listed, number) for entry in row.entries)
    return f'<tr><th scope="row" class="{"beyond" if row.beyond else "paper"}">{label}</th>{cells}</tr>'


def td(entry: Entry, listed: Sequence[str], number: int) -> str:
    """A cell; its title says where it comes from, or what would fill it."""
    if entry.command is not None:
        place = listed.index(entry.command) + 1
        inside = f'<a href="#c{number}-{place}" onclick="{OPEN}">({place})</a>'
        return f'<td class="lacking" title="{html.escape(entry.command)}">{inside}</td>'
    lines = [f'<span class="{line_class(line)}">{html.escape(line.text)}</span>' for line in entry.lines] or ["-"]
    told = "\n".join(f"{name}: {', '.join(values) or 'not recorded'}" for name, values in facts(entry.sources))
    title = f' title="{html.escape(told)}"' if entry.sources else ""
    return f'<td class="{entry.kind}"{title}>{"<br>".join(lines)}</td>'


OPEN = "document.getElementById(this.hash.slice(1)).closest('details').open=true"  # else the link leads nowhere


def line_class(line: Cell) -> str:
    """The class of a line of a cell."""
    return "best" if line.best else "small" if line.small else "number"


def trace_html(trace: Trace) -> str:
    """Where some cells come from."""

    def listed(values: Sequence[str]) -> str:
        return ", ".join(f"<code>{html.escape(value)}</code>" for value in values)

    told = [f"{name} {listed(values) or 'not recorded'}" for name, values in facts(trace.sources)]
    told += [f"measured too, not shown: {listed(names(trace.others))}"] if trace.others else []
    cells = ", ".join(f"<b>{html.escape(row)}</b> ({columns})" for row, columns in trace.parts())
    return f"<li>{cells}: {'; '.join(told)}</li>"


FORMATS: dict[str, Callable[[Sequence[Table], str], str]] = {"md": as_markdown, "html": as_html}
