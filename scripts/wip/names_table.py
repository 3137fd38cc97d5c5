"""In a checkout's top: names_table.py BASE -> table new module <- old modules, and renamed public names."""
import ast,subprocess,sys
from pathlib import Path
base=sys.argv[1]
old=[f for f in subprocess.check_output(["git","ls-tree","-r","--name-only",base,"sparsestreet"],text=True).splitlines() if f.endswith(".py") and not f.endswith("__init__.py")]
def pub(t):
    s=set()
    for n in ast.parse(t).body:
        if isinstance(n,(ast.FunctionDef,ast.ClassDef)): s.add(n.name)
        elif isinstance(n,ast.Assign): s|={x.id for x in n.targets if isinstance(x,ast.Name)}
        elif isinstance(n,ast.AnnAssign) and isinstance(n.target,ast.Name): s.add(n.target.id)
    return s
new={p:pub(p.read_text()) for p in Path("sparsestreet").rglob("*.py") if p.name!="__init__.py"}
idx={}
for p,s in new.items():
    for x in s: idx.setdefault(x,[]).append(p)
d=lambda p: ".".join(Path(p).with_suffix("").parts[1:])
to={}; gone=[]
for f in old:
    if Path(f).exists(): continue
    s=pub(subprocess.check_output(["git","show",f"{base}:{f}"],text=True))
    votes={}
    for x in s:
        c=idx.get(x,[])
        same=[p for p in c if p.parts[1]==Path(f).parts[1]] or c
        if len(same)==1: votes[same[0]]=votes.get(same[0],0)+1
    best=max(votes,key=votes.get) if votes else None
    if best and (best.parts[1]==Path(f).parts[1] and votes[best]*3>=len(s) or votes[best]*2>=len(s) and len(s)>1): to.setdefault(max(votes,key=votes.get),[]).append(f)
    else: gone.append(f)
for p in sorted(to): print(f"| {', '.join('`'+d(f)+'`' for f in to[p])} | `{d(p)}` |")
print("GONE", ", ".join(d(g) for g in gone))
