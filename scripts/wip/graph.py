#!/usr/bin/env python3
"""graph.py FOLDER (e.g. sparsestreet/scene): modules, lines, imports inside the folder, importers. Run in a checkout's top."""
import ast, sys
from pathlib import Path
root=Path("."); room=sys.argv[1].rstrip("/")
mods={}
for p in list(Path("sparsestreet").rglob("*.py")):
    d=".".join(p.with_suffix("").parts); d=d.removesuffix(".__init__"); mods[d]=p
imp={}
for d,p in mods.items():
    s=set()
    for n in ast.walk(ast.parse(p.read_text())):
        if isinstance(n,ast.ImportFrom) and n.module:
            if n.module in mods: s.add(n.module)
            s|={f"{n.module}.{a.name}" for a in n.names if f"{n.module}.{a.name}" in mods}
        elif isinstance(n,ast.Import): s|={a.name for a in n.names if a.name in mods}
    s={x for x in s if not any(y!=x and y.startswith(x+".") for y in s) or not mods[x].name=="__init__.py"}
    imp[d]=s-{d}
pre=room.replace("/",".")
sh=lambda x: x.removeprefix(pre+".") if x.startswith(pre) else x.removeprefix("sparsestreet.")
for d in sorted(m for m in mods if m.startswith(pre)):
    n=len(mods[d].read_text().splitlines())
    ins=[sh(x) for x in sorted(imp[d]) if x.startswith(pre+".")]
    by=[sh(x) for x in sorted(imp) if d in imp[x]]
    print(f"{n:4} {sh(d)}  <- {', '.join(ins) or '-'}  | by {len(by)}: {', '.join(by[:9])}{'...' if len(by)>9 else ''}")
