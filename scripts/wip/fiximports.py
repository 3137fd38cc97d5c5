"""fiximports.py: in a checkout's top, rewrite `from sparsestreet.X import Y` whose X or Y is gone to the only module that defines Y."""
import ast, re, subprocess
from pathlib import Path
mods={}
for p in list(Path("sparsestreet").rglob("*.py"))+list(Path("tests").rglob("*.py")):
    d=".".join(p.with_suffix("").parts).removesuffix(".__init__"); mods[d]=p
defs={}; names={}
for d,p in mods.items():
    t=ast.parse(p.read_text()); s=set(); own=set()
    for n in ast.walk(t):
        if isinstance(n,(ast.FunctionDef,ast.ClassDef)) : pass
    for n in t.body:
        if isinstance(n,(ast.FunctionDef,ast.ClassDef,ast.AsyncFunctionDef)): own.add(n.name)
        elif isinstance(n,ast.Assign):
            for x in n.targets:
                for y in ast.walk(x):
                    if isinstance(y,ast.Name): own.add(y.id)
        elif isinstance(n,ast.AnnAssign) and isinstance(n.target,ast.Name): own.add(n.target.id)
        elif isinstance(n,(ast.If,ast.Try)):
            for y in ast.walk(n):
                if isinstance(y,(ast.FunctionDef,ast.ClassDef)): own.add(y.name)
                elif isinstance(y,ast.Name) and isinstance(y.ctx,ast.Store): own.add(y.id)
                elif isinstance(y,(ast.Import,ast.ImportFrom)): s|={(a.asname or a.name).split(".")[0] for a in y.names}
        elif isinstance(n,(ast.Import,ast.ImportFrom)): s|={(a.asname or a.name).split(".")[0] for a in n.names}
    names[d]=s|own
    for x in own: defs.setdefault(x,[]).append(d)
todo=list(mods.values())+list(Path("benchmarks").glob("*.py"))+list(Path("scripts").glob("*.py"))+list(Path("docs").glob("*.py"))
for p in todo:
    text=p.read_text(); t=ast.parse(text); lines=text.splitlines(keepends=True); edits=[]
    for n in ast.walk(t):
        if isinstance(n,ast.ImportFrom) and n.module and not n.level and n.module.split(".")[0] in("sparsestreet","tests"):
            bad={}
            for a in n.names:
                ok = (n.module in mods and (a.name in names[n.module] or f"{n.module}.{a.name}" in mods))
                if not ok:
                    c=[d for d in defs.get(a.name,[]) if d.split(".")[0]==n.module.split(".")[0]]
                    if len(c)>1:
                        same=[d for d in c if d.split(".")[1]==n.module.split(".")[1]]; c=same or c
                    if len(c)==1: bad[a]=c[0]
                    else: print(f"{p}:{n.lineno}: {n.module}.{a.name}: {c or [m for m in mods if m.endswith('.'+a.name)]}")
            if bad:
                ind=" "*n.col_offset; out=[]
                keep=[a for a in n.names if a not in bad]
                f=lambda a:a.name+(f" as {a.asname}" if a.asname else "")
                if keep: out.append(f"from {n.module} import {', '.join(map(f,keep))}")
                for a,d in bad.items(): out.append(f"from {d} import {f(a)}")
                edits.append((n.lineno-1,n.end_lineno,[(ind+o+"\n") for o in out]))
    for a,b,new in sorted(edits,reverse=True): lines[a:b]=new
    if edits: p.write_text("".join(lines)); print("fixed",p,len(edits))
