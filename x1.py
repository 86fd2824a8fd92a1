from ex import *
go("base")
for b in (1e-4,3e-4,1e-3): go(f"birth {b}",birth=b)
for s in (2.0,3.0,4.0): go(f"vel {s}",vel=(s,.7))
go("newv",newv=.7); go("newv+vel3",newv=.7,vel=(3.,.7))
for g in (.99,.999): go(f"gate {g}",{"association.gate_probability":g})
