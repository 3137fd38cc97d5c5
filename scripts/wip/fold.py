#!/usr/bin/env python3
"""Fold, move and rename modules over the whole checkout (run in the checkout's top, in its venv).

    python /work/notes/fold.py PLAN.yaml [--dry]

PLAN.yaml is a list of groups:

- into: sparsestreet.scene.state          # dotted name of the module that remains (file is made; may be one of `from`)
  doc: "Docstring of the module."         # optional; else the docstring of the module `into`, else of the first
  from: [sparsestreet.scene.state, sparsestreet.scene.options]   # one name: a move
  rename: {sparsestreet.scene.options.Old: New}   # optional: top-level names, renamed everywhere they are imported
- symbols: {sparsestreet.scene.state.Old: New}    # a group without modules: renames top-level names only (names BEFORE folding)

Works for tests too (tests.scene.test_state). Sources are ordered so that what is imported comes first. Private names that
two sources define are renamed with the source's stem (printed); public ones need `rename`. Identical statements are
kept once. Import statements, `module.attribute` uses, dotted names in strings, YAML, docs and paths follow. A package that a
module replaces (into: sparsestreet.scene.body from sparsestreet.scene.body.*) vanishes when its __init__ holds no code.
Afterwards: ruff check --fix --select I,F401,F811,E402 ; ruff format. Look at the diff, then lint-imports, pyright, tests.
"""
import ast, re, subprocess, sys
from pathlib import Path
import yaml

ROOT = Path.cwd()

def path_of(mod):
    p = ROOT / Path(*mod.split("."))
    return p / "__init__.py" if (p / "__init__.py").exists() and not p.with_suffix(".py").exists() else p.with_suffix(".py")

def dotted(path):
    rel = path.relative_to(ROOT).with_suffix("")
    parts = list(rel.parts)
    if parts[-1] == "__init__": parts.pop()
    return ".".join(parts)

def offsets(text):
    out = [0]
    for line in text.splitlines(keepends=True): out.append(out[-1] + len(line))
    return out

class Src:
    def __init__(self, text):
        self.text = text; self.tree = ast.parse(text); self.off = offsets(text); self.edits = []
        self.lines = text.splitlines(keepends=True)
    def pos(self, line, col):
        s = self.lines[line-1] if line-1 < len(self.lines) else ""
        return self.off[line-1] + len(s.encode()[:col].decode())
    def span(self, n): return self.pos(n.lineno, n.col_offset), self.pos(n.end_lineno, n.end_col_offset)
    def edit(self, a, b, t): self.edits.append((a, b, t))
    def done(self):
        t = self.text
        seen = set()
        edits = sorted(set(self.edits), reverse=True)
        inner = {e for e in edits if any(o[0] <= e[0] and e[1] <= o[1] and o[:2] != e[:2] for o in edits)}
        for a, b, r in edits:
            if (a, b) in seen or (a, b, r) in inner: continue
            seen.add((a, b))
            t = t[:a] + r + t[b:]
        return t

def top_names(tree):
    out = {}
    for n in tree.body:
        if isinstance(n, (ast.FunctionDef, ast.ClassDef, ast.AsyncFunctionDef)): out[n.name] = n
        elif isinstance(n, ast.Assign):
            for t in n.targets:
                for m in ast.walk(t):
                    if isinstance(m, ast.Name): out[m.id] = n
        elif isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name): out[n.target.id] = n
        elif isinstance(n, ast.TypeAlias) if hasattr(ast, "TypeAlias") else False: out[n.name.id] = n
        elif isinstance(n, (ast.If, ast.Try)):
            for m in ast.walk(n):
                if isinstance(m, (ast.FunctionDef, ast.ClassDef)): out.setdefault(m.name, n)
                elif isinstance(m, ast.Assign):
                    for t in m.targets:
                        if isinstance(t, ast.Name): out.setdefault(t.id, n)
    return out

def bound_names(tree):
    b = set()
    for n in ast.walk(tree):
        if isinstance(n, (ast.Import, ast.ImportFrom)):
            for a in n.names: b.add((a.asname or a.name).split(".")[0])
        elif isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store): b.add(n.id)
        elif isinstance(n, (ast.FunctionDef, ast.ClassDef)): b.add(n.name)
        elif isinstance(n, ast.arg): b.add(n.arg)
    return b

def rename_names(text, table, strings=False):
    """Rename names (Name, arg if a fixture, def, keyword untouched) inside one source."""
    if not table: return text
    s = Src(text)
    for n in ast.walk(s.tree):
        if isinstance(n, ast.Name) and n.id in table: a, b = s.span(n); s.edit(a, b, table[n.id])
        elif isinstance(n, (ast.FunctionDef, ast.ClassDef, ast.AsyncFunctionDef)) and n.name in table:
            line = s.lines[n.lineno-1]
            a = s.off[n.lineno-1] + re.search(r"(def|class)\s+", line).end()
            s.edit(a, a+len(n.name), table[n.name])
        elif strings and isinstance(n, ast.arg) and n.arg in table:
            a = s.pos(n.lineno, n.col_offset); s.edit(a, a+len(n.arg), table[n.arg])
        elif strings and isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value in table:
            a, b = s.span(n); s.edit(a, b, repr(table[n.value]))
        elif isinstance(n, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in n.targets):
            for c in ast.walk(n.value):
                if isinstance(c, ast.Constant) and c.value in table: a, b = s.span(c); s.edit(a, b, f'"{table[c.value]}"')
        elif isinstance(n, (ast.Global, ast.Nonlocal)):
            a, b = s.span(n); t = s.text[a:b]
            for o, w in table.items(): t = re.sub(rf"\b{o}\b", w, t)
            s.edit(a, b, t)
    # names in string annotations and docstrings' `code`
    out = s.done()
    for o, w in table.items():
        out = re.sub(rf"`{re.escape(o)}`", f"`{w}`", out)
    return out

def main():
    plan = yaml.safe_load(Path(sys.argv[1]).read_text()); dry = "--dry" in sys.argv
    files = [ROOT / f for f in subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], text=True).split("\n") if f]
    files = [f for f in files if f.exists()]
    py = [f for f in files if f.suffix == ".py"]
    new_of, symbols, groups = {}, {}, []
    for g in plan:
        for k, v in (g.get("rename") or {}).items(): symbols[k] = v
        for k, v in (g.get("symbols") or {}).items(): symbols[k] = v
        if "into" not in g: continue
        for m in g["from"]:
            if not path_of(m).exists(): sys.exit(f"no module {m}")
            if m in new_of: sys.exit(f"{m} twice")
            new_of[m] = g["into"]
        groups.append(g)
    taken = {m for m in new_of}
    for g in groups:
        p = ROOT / Path(*g["into"].split(".")).with_suffix(".py")
        if p.exists() and g["into"] not in g["from"]: 
            if g["into"] not in taken: sys.exit(f"{g['into']} exists and is not among its own sources")
    # 1. private collisions inside groups -> renames
    texts = {f: f.read_text() for f in py}
    for g in [g for g in groups for _ in range(3)]:  # again: what renamed names make different
        seen = {}
        for m in g["from"]:
            t = ast.parse(texts[path_of(m)])
            names = top_names(t)
            changed_names = {k.rpartition(".")[2] for k in symbols if k.rpartition(".")[0] == m}
            for name, node in names.items():
                if name == "__all__": continue
                key = f"{m}.{name}"
                if symbols.get(key): name2 = symbols[key]
                else: name2 = name
                seg = ast.get_source_segment(texts[path_of(m)], node)
                if not symbols.get(key) and any(re.search(rf"\b{re.escape(c)}\b", seg) for c in changed_names - {name}): seg = f"{m} {seg}"
                if name2 in seen and seen[name2][1] != seg:
                    if name2.startswith("_") or m.startswith("tests."):
                        stem = m.split(".")[-1].removeprefix("test_")
                        isclass = isinstance(node, ast.ClassDef) or name.lstrip("_")[:1].isupper() and not name.isupper()
                        if name2.isupper(): w = f"{name2}_{stem.upper()}"
                        elif isclass: w = name2 + "".join(x.title() for x in stem.split("_"))
                        else: w = f"{name2}_{stem}" if not name2.startswith("test_") else f"{name2}_{stem}"
                        symbols[key] = w; print(f"renamed {key} -> {w} (beside {seen[name2][0]})"); name2 = w
                    else: sys.exit(f"public name {name2} of {m} also in {seen[name2][0]}: give a rename")
                seen.setdefault(name2, (m, seg))
        # imported names colliding with defined names
        for m in g["from"]:
            t = ast.parse(texts[path_of(m)])
            for n in t.body:
                if isinstance(n, (ast.Import, ast.ImportFrom)):
                    for a in n.names:
                        b = (a.asname or a.name).split(".")[0]
                        src = f"{n.module}.{a.name}" if isinstance(n, ast.ImportFrom) else a.name
                        if b in seen and seen[b][0] != m and not (isinstance(n, ast.ImportFrom) and n.module in g["from"]) :
                            if f"{seen[b][0]}" == src or src in new_of: continue
                            print(f"WARNING {m} imports {b} ({src}); {seen[b][0]} defines {b}")
    by_mod = {}
    for k, v in symbols.items():
        m, _, n = k.rpartition("."); by_mod.setdefault(m, {})[n] = v
    # 2. rewrite every file
    out = {}
    for f in py:
        text = texts[f]; mod = dotted(f)
        own = by_mod.get(mod, {})
        if own: text = rename_names(text, own, strings=mod.startswith("tests."))
        target = new_of.get(mod)
        s = Src(text); names = {}; inline = {}; bound = bound_names(s.tree)
        for n in ast.walk(s.tree):
            if isinstance(n, ast.ImportFrom) and n.module and not n.level:
                pieces = []; changed = False
                keep = []
                for a in n.names:
                    full = f"{n.module}.{a.name}"
                    if full in new_of and not exported(n.module, a.name):
                        w = new_of[full]; par, _, stem = w.rpartition(".")
                        if target == w:
                            inline[a.asname or a.name] = full; changed = True; continue
                        changed = changed or w != full
                        if a.asname and a.asname != stem: pieces.append(f"from {par} import {stem} as {a.asname}")
                        elif (a.asname or a.name) == stem or stem not in bound or any(new_of.get(x) == w for x in mods_imported(s.tree) if x.rpartition('.')[2] == stem):
                            pieces.append(f"from {par} import {stem}")
                            if (a.asname or a.name) != stem: names[a.asname or a.name] = stem
                        else:
                            print(f"WARNING {mod}: {stem} is bound; {w} as {a.name}"); pieces.append(f"from {par} import {stem} as {a.name}")
                    elif n.module in new_of or n.module in by_mod:
                        w = new_of.get(n.module, n.module); sym = by_mod.get(n.module, {}).get(a.name, a.name)
                        if sym != a.name and not a.asname: names[a.name] = sym
                        changed = changed or w != n.module or sym != a.name
                        if target == w:
                            changed = True
                            if a.asname and a.asname != sym: names[a.asname] = sym
                            continue
                        pieces.append(f"from {w} import {sym}" + (f" as {a.asname}" if a.asname else ""))
                    else: keep.append(a.name + (f" as {a.asname}" if a.asname else ""))
                if changed:
                    if keep: pieces.append(f"from {n.module} import {', '.join(keep)}")
                    a, b = s.span(n); ind = " " * n.col_offset
                    if not pieces and n.col_offset:
                        pieces = ["pass"] if only_statement(s.tree, n) else [""]
                    s.edit(a, b, f"\n{ind}".join(pieces))
        handled = set(); local = shadowed(s.tree, set(names) | set(inline))
        for n in ast.walk(s.tree):
            if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name):
                v = n.value.id
                if id(n.value) in local: continue
                if v in inline or v in names or mods_named(s.tree).get(v) in by_mod: handled.add(id(n.value))
                if v in inline:
                    a, b = s.span(n); attr = by_mod.get(inline[v], {}).get(n.attr, n.attr); s.edit(a, b, attr)
                elif mods_named(s.tree).get(v) in by_mod and n.attr in by_mod[mods_named(s.tree)[v]]:
                    a, b = s.span(n); s.edit(a, b, f"{names.get(v, v)}.{by_mod[mods_named(s.tree)[v]][n.attr]}")
                elif v in names: a, b = s.span(n.value); s.edit(a, b, names[v])
        for n in ast.walk(s.tree):
            if isinstance(n, ast.Name) and n.id in names and id(n) not in handled and id(n) not in local:
                a, b = s.span(n); s.edit(a, b, names[n.id])
        new = s.done()
        if new != texts[f]: out[f] = new
    for f, t in out.items(): texts[f] = t
    # 3. build targets
    gone, made = [], {}
    for g in groups:
        srcs = order(g["from"])
        heads, bodies, doc = [], [], g.get("doc")
        tgt = g["into"]
        for m in srcs:
            t = texts[path_of(m)]; s = Src(t)
            body0 = s.tree.body
            if body0 and isinstance(body0[0], ast.Expr) and isinstance(body0[0].value, ast.Constant) and isinstance(body0[0].value.value, str):
                d = ast.get_source_segment(t, body0[0])
                if doc is None and (m == tgt or tgt not in srcs): doc = d
                a, b = s.span(body0[0]); s.edit(a, b, "")
            for n in body0:
                if isinstance(n, (ast.Import, ast.ImportFrom)) or (isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test) and all(isinstance(x, (ast.Import, ast.ImportFrom, ast.Pass)) for x in n.body)):
                    a, b = s.span(n); heads.append(t[a:b]); s.edit(a, b, "")
            bodies.append((m, s.done().strip("\n")))
        if doc is None: doc = '"""."""'
        if not doc.lstrip().startswith(('"""', "'''", 'r"""')): doc = '"""' + doc.strip() + '"""'
        # one __all__
        lists = []
        for i, (m, b) in enumerate(bodies):
            q = Src(b)
            for n in q.tree.body:
                if isinstance(n, ast.Assign) and any(isinstance(x, ast.Name) and x.id == "__all__" for x in n.targets):
                    lists += ast.literal_eval(n.value); a, e = q.span(n); q.edit(a, e, "")
            bodies[i] = (m, q.done().strip("\n"))
        if lists:
            if not all(("__all__" in texts[path_of(m)]) for m in srcs): print(f"NOTE {tgt}: __all__ of some sources only; dropped")
            else: bodies.insert(0, (tgt, "__all__ = " + repr(sorted(set(lists))).replace("'", '"')))
        # identical top-level statements once
        seen, parts = set(), []
        for m, b in bodies:
            if not b.strip(): continue
            s = Src(b)
            for i, n in enumerate(s.tree.body):
                names = [k for k, v in top_names(ast.Module([n], [])).items()]
                seg = ast.get_source_segment(b, n)
                if names and seg in seen:
                    a, e = s.span(n)
                    if isinstance(n, (ast.FunctionDef, ast.ClassDef)) and n.decorator_list:
                        a = s.pos(n.decorator_list[0].lineno, 0)
                    nxt = s.tree.body[i+1] if i+1 < len(s.tree.body) else None
                    if nxt is not None and isinstance(nxt, ast.Expr) and isinstance(nxt.value, ast.Constant) and isinstance(nxt.value.value, str):
                        e = s.span(nxt)[1]
                    s.edit(a, e, "")
                if names: seen.add(seg)
            parts.append(s.done().strip("\n"))
        made[tgt] = doc.rstrip() + "\n\n" + "\n".join(fut(heads)) + "\n\n" + "\n\n\n".join(parts) + "\n"
        gone += [path_of(m) for m in g["from"]]
    # 4. texts elsewhere: dotted names and paths
    table = []
    for m, w in new_of.items():
        if m != w:
            table.append((re.compile(rf"(?<![\w.]){re.escape(m)}(?![\w])"), w))
            table.append((re.compile(rf"{re.escape(m.replace('.', '/'))}\.py\b"), w.replace(".", "/") + ".py"))
            short, shortw = m.split(".", 1)[1].replace(".", "/"), w.split(".", 1)[1].replace(".", "/")
            if "/" in short: table.append((re.compile(rf"(?<![\w/]){re.escape(short)}\.py\b"), shortw + ".py"))
    for k, v in symbols.items():
        m, _, n = k.rpartition("."); table.insert(0, (re.compile(rf"(?<![\w.]){re.escape(k)}(?![\w])"), f"{m}.{v}"))
    def follow(t):
        for r, w in table: t = r.sub(w, t)
        return t
    # longest first
    table.sort(key=lambda x: -len(x[0].pattern))
    if dry: print(len(out), "files change;", len(gone), "sources into", len(made)); return
    for f in gone: f.unlink()
    for g in groups:
        w = g["into"]; base = ROOT / Path(*w.split("."))
        if base.is_dir():
            rest = [x for x in base.rglob("*") if x.is_file() and "__pycache__" not in x.parts]
            if rest and any(x.name != "__init__.py" for x in rest): sys.exit(f"{base} still holds {[x.name for x in rest]}")
            for x in rest:
                tree = ast.parse(x.read_text())
                if any(not isinstance(n, ast.Expr) for n in tree.body): print(f"WARNING: {x} held code")
                x.unlink()
            import shutil; shutil.rmtree(base)
        p = base.with_suffix(".py"); p.parent.mkdir(parents=True, exist_ok=True)
        p.write_text(follow(made[w])); texts[p] = made[w]
        d = p.parent
        while d != ROOT and w.startswith(("sparsestreet", "tests")):
            if not (d / "__init__.py").exists() and d != ROOT: print(f"NOTE {d} has no __init__.py")
            d = d.parent
    for f in files:
        if f in gone or not f.exists(): continue
        if f.suffix == ".py": t0, t = f.read_text(), texts[f]
        elif f.suffix in {".md", ".yaml", ".yml", ".toml", ".sh", ".txt", ".cfg", ".cmake", ".cpp", ".hpp", ".h", ""}  and "CHANGELOG" not in f.name:
            if f.name == "CHANGELOG.md": continue
            try: t0 = t = f.read_text()
            except UnicodeDecodeError: continue
        else: continue
        t2 = follow(t)
        if t2 != t0: f.write_text(t2)
    # packages left empty
    for g in groups:
        for m in g["from"]:
            d = (ROOT / Path(*m.split("."))).parent
            if d.is_dir():
                rest = [x for x in d.rglob("*") if x.is_file() and "__pycache__" not in x.parts]
                if not rest or (len(rest) == 1 and rest[0].name == "__init__.py" and not any(not isinstance(n, ast.Expr) for n in ast.parse(rest[0].read_text()).body)):
                    print(f"removed package {d}"); [x.unlink() for x in rest]; import shutil; shutil.rmtree(d)
    changed = sorted({str(x) for x in list(out) if x.exists()} | {str((ROOT / Path(*w.split('.'))).with_suffix('.py')) for w in made})
    subprocess.run(["ruff", "check", "-q", "--fix", "--select", "I,F401,F811,E402", *changed])
    subprocess.run(["ruff", "format", "-q", *changed])

def fut(heads):
    f = [h for h in heads if h.startswith("from __future__")]
    return list(dict.fromkeys(f)) + list(dict.fromkeys(h for h in heads if not h.startswith("from __future__") and h.strip()))

_cache = {}
def mods_named(tree):
    k = id(tree)
    if k not in _cache:
        d = {}
        for n in ast.walk(tree):
            if isinstance(n, ast.ImportFrom) and n.module:
                for a in n.names: d[a.asname or a.name] = f"{n.module}.{a.name}"
        _cache[k] = (d, tree)
    return _cache[k][0]

def mods_imported(tree): return list(mods_named(tree).values())

def only_statement(tree, node):
    for n in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            b = getattr(n, field, None)
            if isinstance(b, list) and node in b: return len(b) == 1
    return False

_exports = {}
def exported(package, name):
    """Whether a package's __init__ binds the name itself (a function named as its module)."""
    if package not in _exports:
        p = ROOT / Path(*package.split(".")) / "__init__.py"
        b = set()
        if p.exists():
            for n in ast.parse(p.read_text()).body:
                if isinstance(n, ast.ImportFrom) and n.module != package: b |= {x.asname or x.name for x in n.names}
        _exports[package] = b
    return name in _exports[package]

def shadowed(tree, names):
    """ids of nodes inside functions that bind one of the names themselves."""
    out = {}
    for f in ast.walk(tree):
        if isinstance(f, (ast.FunctionDef, ast.Lambda)):
            local = {n.id for n in ast.walk(f) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)} | {n.arg for n in ast.walk(f) if isinstance(n, ast.arg)}
            hit = local & set(names)
            if hit:
                for n in ast.walk(f):
                    if isinstance(n, ast.Name) and n.id in hit: out[id(n)] = True
    return out

def order(mods):
    deps = {}
    for m in mods:
        t = ast.parse(path_of(m).read_text()); d = set()
        for n in ast.walk(t):
            if isinstance(n, ast.ImportFrom) and n.module:
                if n.module in mods: d.add(n.module)
                d |= {f"{n.module}.{a.name}" for a in n.names if f"{n.module}.{a.name}" in mods}
        deps[m] = d - {m}
    out = []
    def visit(m, stack=()):
        if m in out: return
        if m in stack: print(f"WARNING circle {stack} {m}"); return
        for d in [x for x in mods if x in deps[m]]: visit(d, (*stack, m))
        out.append(m)
    for m in mods: visit(m)
    return out

main()
