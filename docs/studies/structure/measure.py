"""Print the size and structure of the source tree as a Markdown table.

    python docs/studies/structure/measure.py [ROOT]

Counts, for every package under ROOT (default: the repository that contains this file): modules, source lines,
public names, functions longer than 60 lines; and for the whole tree: lines with code and of documentation
strings, public class names that are defined more than once, and import cycles (imports under
``TYPE_CHECKING`` and inside functions included).
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

SOURCE_FOLDERS = ("escape_hw", "escape_gui", "drivers", "sim_backends", "benchmarks", "docs", "examples")
LONG_FUNCTION = 60
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip


def package_of(path: Path) -> str:
    """Name under which a file is counted: the first two levels inside ``escape_hw``, else the top folder."""
    parts = path.parts
    if parts[0] == "escape_hw" and len(parts) > 2:
        return "/".join(parts[:2])
    return parts[0]


def module_name(path: Path) -> str:
    """Dotted name of the module in a file, relative to its import root."""
    parts = list(path.with_suffix("").parts)
    if parts[0] in ("drivers", "sim_backends", "benchmarks") and len(parts) > 1:
        parts = parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def documentation_lines(tree: ast.Module) -> set[int]:
    """Numbers of the lines of documentation strings."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
            ast.get_docstring(node, clean=False) is not None
        ):
            lines |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    return lines


def code_lines(text: str) -> set[int]:
    """Numbers of the lines with code or documentation strings: neither empty nor comments only."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return lines


def imported_modules(tree: ast.Module, modules: set[str]) -> set[str]:
    """Modules of this tree that a module imports anywhere, also inside functions and for type checkers."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in modules else node.module)
    return found & modules


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components with more than one module (Tarjan's algorithm)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    result: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            component = []
            while True:
                component.append(stack.pop())
                if component[-1] == node:
                    break
            if len(component) > 1:
                result.append(sorted(component))

    sys.setrecursionlimit(10_000)
    for node in graph:
        if node not in index:
            visit(node)
    return result


def main(root: Path) -> None:
    """Print the tables."""
    files = sorted(
        path.relative_to(root)
        for folder in SOURCE_FOLDERS
        for path in (root / folder).rglob("*.py")
        if "_build" not in path.parts
    )
    texts = {path: (root / path).read_text(encoding="utf-8") for path in files}
    trees = {path: ast.parse(text) for path, text in texts.items()}
    lines, modules, public, long = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    classes: dict[str, list[str]] = {}
    for path, tree in trees.items():
        package = package_of(path)
        modules[package] += 1
        lines[package] += len(texts[path].splitlines())
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                public[package] += 1
                if isinstance(node, ast.ClassDef):
                    classes.setdefault(node.name, []).append(module_name(path))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= LONG_FUNCTION:
                long[package] += 1
    print("| package | modules | source lines | public names | functions over 60 lines |")
    print("|---|---:|---:|---:|---:|")
    for package in sorted(modules):
        print(f"| {package} | {modules[package]} | {lines[package]} | {public[package]} | {long[package]} |")
    print(f"| **all** | {modules.total()} | {lines.total()} | {public.total()} | {long.total()} |\n")
    documentation = {path: documentation_lines(tree) for path, tree in trees.items()}
    n_code = sum(len(code_lines(text) - documentation[path]) for path, text in texts.items())
    print(f"Lines with code: {n_code}; of documentation strings: {sum(map(len, documentation.values()))}\n")
    twice = {name: where for name, where in classes.items() if len(where) > 1}
    print(f"Public class names defined more than once: {len(twice)}\n")
    for name, where in sorted(twice.items()):
        print(f"- `{name}`: {', '.join(where)}")
    names = {module_name(path): tree for path, tree in trees.items()}
    graph = {name: imported_modules(tree, set(names)) - {name} for name, tree in names.items()}
    # The flat public namespace names its members for type checkers and loads them lazily.
    graph["escape_hw"] = set()
    found = cycles(graph)
    print(f"\nImport cycles: {len(found)}\n")
    for component in found:
        print(f"- {', '.join(component)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[3])
