"""Errors for `mutants.py`: expressions of Python and of C++ with one error each."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Functions and arguments of which nothing can be observed but a text, the speed, other samples, or an answer's last digits.
SKIPPED_FUNCTIONS = ("__repr__", "__str__", "_repr_html_")
SKIPPED_CALLS = re.compile(r"(^|\.)(warn|\w*Error|default_rng)$")
SKIPPED_ARGUMENTS = re.compile(r"\w*tol\w*|strict|stacklevel|maxsize|max_?iter\w*|copy|check_finite|overwrite_\w+|frozen|slots")
ROUNDING = 1e-6  # smaller numbers are thresholds of rounding


def both_ways(*pairs: tuple[Any, Any]) -> dict[Any, Any]:
    """A table in which each of a pair leads to the other."""
    return {one: other for pair in pairs for one, other in (pair, pair[::-1])}


COMPARISONS = both_ways((ast.Lt, ast.GtE), (ast.LtE, ast.Gt), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn))
OPERATORS = both_ways((ast.Add, ast.Sub), (ast.Mult, ast.Div)) | {ast.MatMult: ast.Mult, ast.Pow: ast.Mult}
# Replaced in code lines of C++. A unary minus and templates do not match, for operators have blanks on both sides.
CXX_PAIRS = [("+", "-"), ("*", "/"), ("<", ">="), ("<=", ">"), ("==", "!="), ("&&", "||"), ("+=", "-=")]
CXX_CHANGES = both_ways(*((f" {one} ", f" {other} ") for one, other in CXX_PAIRS))
CXX_NUMBER = re.compile(r"(?<![\w.])\d+\.\d+(e-?\d+)?")
CXX_SKIPPED = re.compile(r"^\s*(//|#|throw|template|using|namespace)|static_assert|InputError|operator|toleran|reserve\(")


@dataclass(frozen=True)
class Mutant:
    """A file with one error."""

    file: Path  # relative to the root
    line: int
    function: str  # that has the error, as Python names it; empty for C++ and for code outside functions
    text: str

    def changed_line(self) -> str:
        """The line with the error, if the error changes no other line."""
        return self.text.splitlines(keepends=True)[self.line - 1]


def changed(node: ast.AST) -> ast.AST | None:
    """A copy of an expression with an error; None if there is none to make."""
    new = copy.deepcopy(node)
    match new:
        case ast.Compare(ops=[operator]) if type(operator) in COMPARISONS:
            new.ops = [COMPARISONS[type(operator)]()]
        case ast.BinOp(op=operator) if type(operator) in OPERATORS:
            new.op = OPERATORS[type(operator)]()
        case ast.BoolOp(op=operator):
            new.op = ast.Or() if isinstance(operator, ast.And) else ast.And()
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            return operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value) | float(value)) if not 0.0 < abs(value) < ROUNDING:
            new.value = value + 1 if isinstance(value, int) else (1.5 * value if value else 1.0)
        case ast.IfExp():
            new.body, new.orelse = new.orelse, new.body
        case _:
            return None
    return new


def expressions(node: ast.AST, function: str = "") -> Iterator[tuple[ast.expr, str]]:
    """All expressions that are computed and can be observed, each with the name of its function."""
    match node:
        case ast.Raise() | ast.Assert() | ast.JoinedStr():
            return
        case ast.Call(func=called) if SKIPPED_CALLS.search(ast.unparse(called)):
            return
        case ast.keyword(arg=str(name)) if SKIPPED_ARGUMENTS.fullmatch(name):
            return
        case ast.FunctionDef(name=name) if name in SKIPPED_FUNCTIONS:
            return
    if isinstance(node, ast.expr):
        yield node, function
    inside = function
    if isinstance(node, ast.FunctionDef):
        inside = f"{function}{node.name}.<locals>."
    elif isinstance(node, ast.ClassDef):
        inside = f"{function}{node.name}."
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from expressions(child, inside if name == "body" else function)


def python_mutants(file: Path, text: str) -> list[Mutant]:
    """All mutants of a Python file."""
    source = text.encode()
    lines = source.splitlines(keepends=True)
    found = []
    module = ast.parse(text)
    module.body = [statement for statement in module.body if not isinstance(statement, ast.Assign | ast.AnnAssign)]
    for node, function in expressions(module):
        new = changed(node)
        if new is None or node.end_lineno is None:
            continue
        start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
        end = sum(map(len, lines[: node.end_lineno - 1])) + (node.end_col_offset or 0)
        mutated = source[:start] + f"({ast.unparse(new)})".encode() + source[end:]
        name = function.removesuffix(".<locals>.") if function.endswith(".<locals>.") else ""
        found.append(Mutant(file, node.lineno, name, mutated.decode()))
    return found


def cxx_mutants(file: Path, text: str) -> list[Mutant]:
    """All mutants of a C++ file."""
    lines = text.splitlines(keepends=True)
    found = []
    for number, line in enumerate(lines):
        code = line.partition("//")[0]
        if CXX_SKIPPED.search(line):
            continue
        spots = [
            (match.start(), before, after)
            for before, after in CXX_CHANGES.items()
            for match in re.finditer(re.escape(before), code)
        ]
        spots += [
            (match.start(), match[0], f"(1.5 * {match[0]} + 1e-3)")
            for match in CXX_NUMBER.finditer(code)
            if not 0.0 < float(match[0]) < ROUNDING
        ]
        for place, before, after in spots:
            new = line[:place] + after + line[place + len(before) :]
            text = "".join([*lines[:number], new, *lines[number + 1 :]])
            found.append(Mutant(file, number + 1, "", text))
    return found


CXX_NO_CHOICE = re.compile(r"constexpr|static |\bcase |template|: public|#")
# Where an expression of C++ begins and ends, beside brackets and commas.
CXX_BEGIN = re.compile(r"(return|[{;(,]| [-+*/]?=) $")
# Each place with an error notes in a shared file of one byte for each error that it was reached.
CXX_MOST = 4096  # errors in one build
CXX_SWITCH = """#pragma once
#include <cstdlib>
#include <fcntl.h>
#include <sys/mman.h>
inline const int seeded_error = [] { const char* text = std::getenv("SEEDED_ERROR"); return text ? std::atoi(text) : -1; }();
inline volatile char* const reached_errors = static_cast<volatile char*>(
    mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, open(std::getenv("SEEDED_REACHED"), O_RDWR), 0));
inline bool is_seeded(int number) {
    reached_errors[number] = 1;
    return number == seeded_error;
}
"""


def switched(before: str, after: str, number: int) -> str | None:
    """A line of C++ that has an error only where SEEDED_ERROR is a number; None if its expression is not all in the line."""
    if CXX_NO_CHOICE.search(before):
        return None
    same = common_length(before, after)
    rest = min(common_length(before[::-1], after[::-1]), len(before) - same, len(after) - same)
    back = expression_edge(before[:same][::-1], ")]}", "([{", True)
    forward = expression_edge(before[len(before) - rest :], "([{", ")]}", False)
    if back is None or forward is None:
        return None
    begin = same - back
    end = len(before) - rest + forward
    one, other = before[begin:end], after[begin : end + len(after) - len(before)]
    return f"{before[:begin]}(is_seeded({number}) ? ({other}) : ({one})){before[end:]}"


def common_length(one: str, other: str) -> int:
    """The number of characters with which both texts begin."""
    return next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))


def expression_edge(text: str, opening: str, closing: str, backwards: bool) -> int | None:
    """How far an expression extends in a text, which is read backwards or forwards; None if it extends to another line."""
    depth = 0
    for k, character in enumerate(text):
        if character in opening:
            depth += 1
        elif character in closing:
            depth -= 1
            if depth < 0:
                return k
        elif depth == 0 and (character in ",;" or (backwards and CXX_BEGIN.search(text[k : k + 8][::-1]))):
            return k
    return None
