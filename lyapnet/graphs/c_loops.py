"""Statements of C in loops: joins loops, and lets arrays share memory after the last read."""

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

ASSIGNMENT = re.compile(r"(\w+)\[([^][]*)\] ([-+*]?=) .*;")  # to one entry of an array
ARRAY = re.compile(r"\bv\d+\b")
ENTRY = re.compile(r"\b(v\d+)\[[^][]*\]")


@dataclass(frozen=True)
class Statement:
    """A line of C within loops over i0 < sizes[0], i1 < sizes[1], …; the function's arrays are called v0, v1, …"""

    sizes: tuple[int, ...]
    line: str

    @cached_property
    def entries(self) -> dict[str, set[str | None]]:
        """Array ↦ the indices of its entries in the line; None if the line names the array itself."""
        found = defaultdict[str, set[str | None]](set)
        for name in ARRAY.finditer(self.line):
            found[name[0]].add(_index_at(self.line, name.end()))
        return dict(found)

    @cached_property
    def _assignment(self) -> re.Match[str] | None:
        """The match of ASSIGNMENT, (array, index, sign), if the line is an assignment and nothing else."""
        return None if any(None in indices for indices in self.entries.values()) else ASSIGNMENT.fullmatch(self.line)

    @property
    def assigned(self) -> str | None:
        """The array that the line assigns to; None if it does anything else."""
        return None if self._assignment is None else self._assignment[1]

    @property
    def is_first_assignment(self) -> bool:
        """Whether the line is an assignment by = that does not read the array to which it assigns."""
        found = self._assignment
        return found is not None and found[3] == "=" and self.line.count(f"{found[1]}[") == 1

    @cached_property
    def writes_each_entry_once(self) -> bool:
        """Whether each pass of the loops assigns to another entry."""
        found = self._assignment
        return found is not None and all(re.search(rf"\bi{k}\b", found[2]) for k in range(len(self.sizes)))

    @property
    def written(self) -> Iterable[str]:
        """The arrays v0, v1, … to which the line may write; arrays of results have other names."""
        name = self.assigned
        return self.entries if name is None else [name] if name in self.entries else []


def _index_at(line: str, start: int) -> str | None:
    """The text in the brackets that begin at a position; None if there are none."""
    if line[start : start + 1] != "[":
        return None
    depth = 0
    for end in range(start, len(line)):
        depth += {"[": 1, "]": -1}.get(line[end], 0)
        if not depth:
            return line[start + 1 : end]
    return None


@dataclass
class Group:
    """Statements in the same loops, one after another in each pass."""

    sizes: tuple[int, ...]
    statements: list[Statement] = field(default_factory=list)
    entries: dict[str, set[str | None]] = field(default_factory=lambda: defaultdict(set))
    written: dict[str, bool] = field(default_factory=dict)  # array ↦ whether each pass writes to another entry

    def add(self, statement: Statement) -> None:
        self.statements.append(statement)
        for name, indices in statement.entries.items():
            self.entries[name] |= indices
        for name in statement.written:
            self.written[name] = self.written.get(name, True) and statement.writes_each_entry_once

    def can_take(self, statement: Statement) -> bool:
        """Whether a statement may be appended to these loops instead of having its own, with the same results.

        Entries that one pass writes must not be read or written by other passes.
        """
        if statement.sizes != self.sizes or statement.assigned is None:
            return False
        if not self.sizes:
            return True
        if any(each.assigned is None for each in self.statements):
            return False
        writes = dict.fromkeys(statement.written, statement.writes_each_entry_once)
        for name, indices in statement.entries.items():
            if name not in self.entries or not (name in self.written or name in writes):
                continue
            one_entry_each = self.written.get(name, True) and writes.get(name, True)
            if not one_entry_each or len(self.entries[name] | indices) > 1:
                return False
        return True

    def conflicts_with(self, statement: Statement) -> bool:
        """Whether results depend on the order of this group and a statement."""
        return any(name in self.written for name in statement.entries) or any(
            name in self.entries for name in statement.written
        )

    def feeds(self, statement: Statement) -> bool:
        """Whether a statement reads an array that this group writes."""
        return any(name in self.written for name in statement.entries)


def arrange_statements(statements: Sequence[Statement], arrays: Mapping[str, int]) -> tuple[list[str], int]:
    """(the lines of a function's body, the number of entries of its arrays m0, m1, … in all).

    Arrays that nothing reads are left out. Loops over the same sizes are joined. An array that is read only in the loop
    that writes it becomes a number. All other arrays share the memory m0, m1, …: after its last read, an array's memory
    is used by another one. The parts are separate arrays so that compilers know that they do not overlap.

    Args:
        statements: the statements in their order.
        arrays: name ↦ number of entries.
    """
    groups = _join_loops(_remove_unread(statements))
    numbers = _find_numbers(groups, arrays)
    lives = _find_lives(groups, numbers)
    memory, places = _assign_memory({name: arrays[name] for name in lives}, lives, groups)
    lines = [f"double {', '.join(f'm{k}[{size}]' for k, size in enumerate(memory))};"] if memory else []
    declared = set[str]()
    for group in groups:
        for name in group.entries:
            if name in places and name not in declared:
                declared.add(name)
                lines.append(f"double *const {name} = m{places[name]};  /* {arrays[name]} */")
        lines += _write_group(group, numbers, declared)
    return lines, sum(memory)


def loop_heads(sizes: Sequence[int], counter: str = "int") -> list[str]:
    """The first lines of nested loops over sizes."""
    return [f"{'    ' * k}for ({counter} i{k} = 0; i{k} < {size}; i{k}++)" for k, size in enumerate(sizes)]


def _remove_unread(statements: Sequence[Statement]) -> list[Statement]:
    """The statements without assignments to arrays that no later statement reads."""
    kept, read = list[Statement](), set[str]()
    for statement in reversed(statements):
        if statement.assigned not in statement.entries or statement.assigned in read:
            kept.append(statement)
            read |= set(statement.entries)
    return kept[::-1]


def _join_loops(statements: Sequence[Statement]) -> list[Group]:
    """Groups of statements; each statement joins the last group that can take it and whose results it reads.

    Other statements, such as first values of sums, have their own group: in an earlier one they would occupy memory for
    longer.
    """
    groups = list[Group]()
    for statement in statements:
        for k in reversed(range(len(groups))):
            near = k == len(groups) - 1 and not statement.sizes
            if groups[k].can_take(statement) and (near or groups[k].feeds(statement)):
                groups[k].add(statement)
                break
            if groups[k].conflicts_with(statement):
                groups.append(Group(statement.sizes))
                groups[-1].add(statement)
                break
        else:
            groups.append(Group(statement.sizes))
            groups[-1].add(statement)
    return groups


def _find_numbers(groups: Sequence[Group], arrays: Mapping[str, int]) -> set[str]:
    """The arrays that can be a number: with one entry, or with one that matters in each pass of a single loop."""
    found = dict[str, list[tuple[int, Statement]]]()
    for k, group in enumerate(groups):
        for statement in group.statements:
            for name in statement.entries:
                found.setdefault(name, []).append((k, statement))
    return {name for name, at in found.items() if _is_number(name, at, arrays[name])}


def _is_number(name: str, at: Sequence[tuple[int, Statement]], size: int) -> bool:
    (_, first), indices = at[0], {index for _, statement in at for index in statement.entries[name]}
    if len(indices) > 1 or None in indices or not first.is_first_assignment or first.assigned != name:
        return False
    if any(statement.assigned is None for _, statement in at):
        return False
    return (size == 1 and not first.sizes) or (first.writes_each_entry_once and len({k for k, _ in at}) == 1)


def _find_lives(groups: Sequence[Group], numbers: set[str]) -> dict[str, tuple[int, int]]:
    """Array ↦ the first and the last group that uses it, for arrays that are no numbers."""
    lives = dict[str, tuple[int, int]]()
    for k, group in enumerate(groups):
        for name in group.entries:
            if name not in numbers:
                lives[name] = lives.get(name, (k, k))[0], k
    return lives


def _assign_memory(
    sizes: Mapping[str, int], lives: Mapping[str, tuple[int, int]], groups: Sequence[Group]
) -> tuple[list[int], dict[str, int]]:
    """(the sizes of the parts of the memory, array ↦ its part): the first part that is free while the array is used.

    The largest arrays choose first, so that no part has to grow.
    """

    def is_past(old: str, new: str) -> bool:
        end, begin = lives[old][1], lives[new][0]
        return end < begin or (end == begin and _can_replace(groups[begin], old, new))

    memory, tenants, places = list[int](), list[list[str]](), dict[str, int]()
    for name in sorted(sizes, key=lambda name: (-sizes[name], lives[name])):
        free = (
            k for k, taken in enumerate(tenants) if all(is_past(each, name) or is_past(name, each) for each in taken)
        )
        place = next(free, len(memory))
        if place == len(memory):
            memory.append(sizes[name])
            tenants.append([])
        tenants[place].append(name)
        places[name] = place
    return memory, places


def _can_replace(group: Group, old: str, new: str) -> bool:
    """Whether a new array may use the memory of an old one that is read for the last time in the same loops.

    This needs passes that read only their own entry of the old array, and before they write the new one there.
    """
    indices = group.entries[old] | group.entries[new]
    if not group.sizes or len(indices) > 1 or any(each.assigned is None for each in group.statements):
        return False
    last = max(k for k, each in enumerate(group.statements) if old in each.entries)
    first = min(k for k, each in enumerate(group.statements) if new in each.entries)
    return last <= first and group.statements[first].assigned == new and group.statements[first].writes_each_entry_once


def _write_group(group: Group, numbers: set[str], declared: set[str]) -> list[str]:
    """The lines of a group; numbers are declared by their first assignment."""
    body = list[str]()
    for statement in group.statements:
        name, line = statement.assigned, statement.line
        line = ENTRY.sub(lambda entry: entry[1] if entry[1] in numbers else entry[0], line)
        if name in numbers and name not in declared:
            declared.add(name)
            line = f"double {line}"
        body.append(line)
    heads, depth = loop_heads(group.sizes), len(group.sizes)
    several = depth > 0 and len(body) > 1
    if several:
        heads[-1] += " {"
    inner = [*heads, *("    " * depth + line for line in body)]
    return [*inner, "    " * (depth - 1) + "}"] if several else inner
