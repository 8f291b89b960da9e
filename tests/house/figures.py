"""The bars of this house, read from the source: `python tests/house/figures.py` prints each figure and its offenders.

Each function takes the root of a checkout and returns a list of offenders, one line each, or a `Share`.
"""

from __future__ import annotations

import argparse
import ast
import collections
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOP = ("popgen", "actors", "pipelines", "conf")  # popgen/actors, popgen/pipelines, popgen/conf are links: read once
SAME_ROLE = ("__init__.py", "__main__.py")
SELF_PLAY_SCORE = "sp"  # also a method's name; reports have a column of it
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Share:
    """A part of a whole, and the lines that make it up."""

    lines: list[str]
    total: int

    @property
    def percent(self) -> float:
        """The part in percent of the whole."""
        return 100 * len(self.lines) / max(self.total, 1)


def list_sources(root: Path, *folders: str) -> list[Path]:
    """Python files of some top-level folders; links are not followed."""
    return sorted(path for folder in folders or TOP for path in (root / folder).rglob("*.py") if path.is_file())


@cache
def parse_file(path: Path) -> ast.Module:
    """The syntax tree of a file, which all bars share."""
    return ast.parse(path.read_text())


@cache
def list_nodes(tree: ast.Module) -> list[ast.AST]:
    """Every node of a file, which all bars share too."""
    return [*ast.walk(tree)]


def parse_sources(root: Path, *folders: str) -> Iterator[tuple[str, ast.Module]]:
    """(name relative to the root, syntax tree) of every file."""
    for path in list_sources(root, *folders):
        if not any(parent.is_symlink() for parent in path.relative_to(root).parents if str(parent) != "."):
            yield str(path.relative_to(root)), parse_file(path)


def iter_functions(root: Path, *folders: str) -> Iterator[tuple[str, Function]]:
    """(file, function) for every function and method."""
    for name, tree in parse_sources(root, *folders):
        yield from ((name, node) for node in list_nodes(tree) if isinstance(node, Function))


def iter_classes(root: Path) -> Iterator[tuple[str, ast.ClassDef]]:
    """(file, class) for every class."""
    for name, tree in parse_sources(root):
        yield from ((name, node) for node in list_nodes(tree) if isinstance(node, ast.ClassDef))


def count_lines(node: Function | ast.ClassDef) -> int:
    """Lines from `def` or `class` to the last one."""
    return (node.end_lineno or node.lineno) - node.lineno + 1


def find_long_functions(root: Path, longest: int = 50) -> list[str]:
    """Functions with more lines than `longest`, tests included."""
    return [
        f"{name}:{node.lineno} {node.name} has {count_lines(node)} lines"
        for name, node in iter_functions(root, *TOP, "tests")
        if count_lines(node) > longest
    ]


def find_long_classes(root: Path, longest: int = 200) -> list[str]:
    """Classes with more lines than `longest`."""
    return [
        f"{name}:{node.lineno} {node.name} has {count_lines(node)} lines"
        for name, node in iter_classes(root)
        if count_lines(node) > longest
    ]


def list_methods(root: Path) -> set[str]:
    """The keys of the registry's table."""
    tables = [
        node.value
        for node in parse_file(root / "popgen" / "methods" / "registry.py").body
        if isinstance(node, ast.AnnAssign) and getattr(node.target, "id", "") == "BUILT_IN"
    ]
    return {str(name) for table in tables for name in ast.literal_eval(table)}


def find_method_literals(root: Path) -> list[str]:
    """String constants that name a method, alone or as `method=NAME`, outside popgen/methods and conf/."""
    names = list_methods(root) - {SELF_PLAY_SCORE}
    methods = names | {f"method={name}" for name in names | {SELF_PLAY_SCORE}}
    return [
        f"{name}:{node.lineno} {node.value!r}"
        for name, tree in parse_sources(root)
        if not name.startswith(("popgen/methods/", "conf/"))
        for node in list_nodes(tree)
        if isinstance(node, ast.Constant) and node.value in methods
    ]


def find_repeated_names(root: Path) -> list[str]:
    """Base names of files that occur more than once, packages' own files apart."""
    places = collections.defaultdict(list)
    for path in list_sources(root):
        if path.name not in SAME_ROLE:
            places[path.name].append(str(path.relative_to(root).parent))
    return [f"{name} in {', '.join(folders)}" for name, folders in sorted(places.items()) if len(folders) > 1]


def find_long_algorithm(root: Path, longest: int = 250) -> list[str]:
    """Lines of Algorithm 1's file, both phases, beyond the `longest`."""
    name = "popgen/methods/xpm_wm/train.py"
    lines = len((root / name).read_text().splitlines())
    return [f"{name}:{line}" for line in range(longest + 1, lines + 1)]


def measure_short_helpers(root: Path) -> Share:
    """Private functions whose name is one word, of all functions."""
    functions = list(iter_functions(root))
    lines = [f"{name}:{node.lineno} {node.name}" for name, node in functions if is_short_helper(node.name)]
    return Share(lines, len(functions))


def is_short_helper(name: str) -> bool:
    """Whether a name is a private one of one word."""
    return name.startswith("_") and not name.startswith("__") and len(name) > 1 and "_" not in name[1:]


def find_many_returns(root: Path) -> list[str]:
    """Ray calls with three or more return values."""
    return [
        f"{name}:{node.value.lineno} num_returns={node.value.value}"
        for name, tree in parse_sources(root)
        for node in list_nodes(tree)
        if isinstance(node, ast.keyword) and node.arg == "num_returns" and isinstance(node.value, ast.Constant)
        if node.value.value >= 3
    ]


def find_wide_tuples(root: Path) -> list[str]:
    """Public functions that return tuples of three or more entries, by their annotation."""
    lines = []
    for name, node in iter_functions(root):
        match node.returns:
            case ast.Subscript(value=ast.Name(id="tuple"), slice=ast.Tuple(elts=elements)) if len(elements) > 2:
                if not node.name.startswith("_"):
                    lines.append(f"{name}:{node.lineno} {node.name} returns {len(elements)} values")
    return lines


def find_positional_counters(root: Path) -> list[str]:
    """Entries named "counters" that are lists or tuples."""
    return [
        f"{name}:{node.lineno}"
        for name, tree in parse_sources(root)
        for node in list_nodes(tree)
        if isinstance(node, ast.Dict)
        for key, value in zip(node.keys, node.values, strict=True)
        if isinstance(key, ast.Constant) and key.value == "counters" and isinstance(value, ast.List | ast.Tuple)
    ]


# Attributes


def list_targets(node: ast.AST) -> list[ast.expr]:
    """What a statement assigns to."""
    match node:
        case ast.Assign(targets=targets):
            return targets
        case ast.AnnAssign(target=target) | ast.AugAssign(target=target) | ast.For(target=target):
            return [target]
        case ast.With(items=items):
            return [item.optional_vars for item in items if item.optional_vars]
    return []


def list_attributes(function: Function) -> dict[str, int]:
    """Attribute of `self` -> line where a method sets it."""
    found: dict[str, int] = {}
    for node in ast.walk(function):
        for target in list_targets(node):
            for part in ast.walk(target):
                match part:
                    case ast.Attribute(value=ast.Name(id="self"), attr=attr, ctx=ast.Store()):
                        found.setdefault(attr, part.lineno)
    return found


def list_declared(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Attributes that a class or one of its bases in this tree sets in its body or in `__init__`."""
    foreign = any(base_name(base) not in classes for base in node.bases)
    has_init = any(isinstance(item, Function) and item.name == "__init__" for item in node.body)
    names: set[str] = set()
    for item in node.body:
        match item:
            case ast.Assign(targets=targets):
                names |= {target.id for target in targets if isinstance(target, ast.Name)}
            case ast.AnnAssign(target=ast.Name(id=name), value=value):
                # A class that a framework constructs may only declare what the framework's hooks then set.
                names |= {name} if value is not None or foreign or not has_init else set()
            case ast.FunctionDef(name="__init__" | "__post_init__" | "__new__"):
                names |= set(list_attributes(item))
            case ast.FunctionDef(name=name, decorator_list=[_, *_]):
                names.add(name)  # properties
    for base in node.bases:
        if (name := base_name(base)) in classes and classes[name] is not node:
            names |= list_declared(classes[name], classes)
    return names


def base_name(node: ast.expr) -> str:
    """The last word of a base class."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
        case ast.Subscript(value=value):
            return base_name(value)
    return ""


def find_late_attributes(root: Path) -> list[str]:
    """Attributes of `self` that are first set outside `__init__`."""
    classes = {node.name: node for _, node in iter_classes(root)}
    lines = []
    for name, node in iter_classes(root):
        declared = list_declared(node, classes)
        for item in node.body:
            if isinstance(item, Function):
                late = {key: line for key, line in list_attributes(item).items() if key not in declared}
                lines += [f"{name}:{line} {node.name}.{key} in {item.name}" for key, line in late.items()]
    return lines


# Imports


def read_imports(root: Path) -> dict[str, set[str]]:
    """Module -> modules of this project that it imports anywhere, TYPE_CHECKING and functions included."""
    modules = {name_module(path.relative_to(root)) for path in list_sources(root)}
    graph: dict[str, set[str]] = {}
    for name, tree in parse_sources(root):
        module = name_module(Path(name))
        package = module if Path(name).name == "__init__.py" else module.rpartition(".")[0]
        graph[module] = {target for target in iter_targets(tree, package, modules) if target != module}
    return graph


def name_module(path: Path) -> str:
    """The dotted name of a file; the top-level rooms are packages of popgen."""
    parts = [part for part in path.with_suffix("").parts if part != "__init__"]
    return ".".join(parts if parts[0] == "popgen" else ["popgen", *parts])


def iter_targets(tree: ast.Module, package: str, modules: set[str]) -> Iterator[str]:
    """Modules of this project that a file imports."""
    for node in list_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                if whole in modules or base in modules:
                    yield whole if whole in modules else base


def find_import_cycles(root: Path) -> list[str]:
    """Groups of modules that import each other, directly or not."""
    graph = read_imports(root)
    reach = {module: reachable(graph, module) for module in graph}
    groups = {frozenset(other for other in reach[module] if module in reach[other]) for module in graph}
    return [" <-> ".join(sorted(group)) for group in sorted(groups, key=sorted) if group]


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    """Every module that `start` needs."""
    reached: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += graph.get(module, ())
    return reached


# Annotations, docstrings, the schema


def measure_annotations(root: Path) -> Share:
    """Parameters without an annotation, of all but self and cls."""
    lines, total = [], 0
    for name, node in iter_functions(root):
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        named = [argument for argument in arguments if argument.arg not in ("self", "cls")]
        total += len(named)
        lines += [f"{name}:{node.lineno} {node.name}({item.arg})" for item in named if item.annotation is None]
    return Share(lines, total)


def measure_docstrings(root: Path) -> Share:
    """Public functions and classes without a docstring."""
    nodes = [*iter_functions(root), *iter_classes(root)]
    public = [(name, node) for name, node in nodes if not node.name.startswith("_")]
    return Share(
        [f"{name}:{node.lineno} {node.name}" for name, node in public if ast.get_docstring(node) is None], len(public)
    )


def find_undescribed_fields(root: Path) -> list[str]:
    """Fields of the methods' JSON schemas without a description, each once."""
    sys.path.insert(0, str(root))
    from popgen.methods.registry import METHODS

    lines: set[str] = set()
    for method in METHODS.values():
        schema = method.config.model_json_schema()
        models = {schema["title"]: schema, **schema.get("$defs", {})}
        lines |= {
            f"{model}.{field}"
            for model, body in models.items()
            for field, entry in body.get("properties", {}).items()
            if not entry.get("description", "").strip()
        }
    return sorted(lines)


@dataclass(frozen=True)
class Bar:
    """What a figure may be at most, and how it is measured."""

    name: str
    most: float
    measure: Callable[[Path], list[str] | Share]


BARS = (
    Bar("methods' names as literals outside popgen/methods and conf", 5, find_method_literals),
    Bar("base names of files that occur twice", 8, find_repeated_names),
    Bar("private helpers of one word, %", 5, measure_short_helpers),
    Bar("functions over 50 lines", 0, find_long_functions),
    Bar("classes over 200 lines", 0, find_long_classes),
    Bar("lines of Algorithm 1 (popgen/methods/xpm_wm/train.py) over 250", 0, find_long_algorithm),
    Bar("attributes first set outside __init__", 0, find_late_attributes),
    Bar("cycles of imports", 0, find_import_cycles),
    Bar("num_returns of three or more", 0, find_many_returns),
    # PettingZoo's `step` and the key of a ledger entry.
    Bar("public functions that return three values or more", 2, find_wide_tuples),
    Bar("positional counters", 0, find_positional_counters),
    Bar("parameters without annotation, %", 5, measure_annotations),
    Bar("public names without docstring, %", 5, measure_docstrings),
    Bar("fields without a description", 0, find_undescribed_fields),
)


def judge(bar: Bar, root: Path) -> tuple[float, list[str]]:
    """The figure of a bar, and its offenders."""
    result = bar.measure(root)
    if isinstance(result, Share):
        return result.percent, result.lines
    return float(len(result)), result


def print_figures(root: Path, most_lines: int, words: Iterable[str]) -> bool:
    """Print the bars whose name contains one of `words`; whether all hold."""
    good = True
    for bar in BARS:
        if any(word in bar.name for word in words):
            figure, lines = judge(bar, root)
            good &= figure <= bar.most
            print(f"{'ok  ' if figure <= bar.most else 'OVER'} {figure:6.4g} of {bar.most:<3g} {bar.name}")
            print(*(f"       {line}" for line in lines[:most_lines]), sep="\n", end="\n" if lines[:most_lines] else "")
    return good


def main() -> int:
    """Print all figures, or those whose name contains one of the words given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", default=[""], help="parts of bars' names; all without")
    parser.add_argument("--root", type=Path, default=ROOT, help="a checkout")
    parser.add_argument("--lines", type=int, default=0, help="offenders to print for each bar")
    arguments = parser.parse_args()
    return not print_figures(arguments.root.resolve(), arguments.lines, arguments.words or [""])


if __name__ == "__main__":
    sys.exit(main())
