from dataclasses import dataclass
import casadi as ca


@dataclass(frozen=True)
class Native:
    function: ca.Function
    compiled: bool
    reason: str


def native(function):
    import hashlib, subprocess, os

    name = "fpirhc_" + hashlib.sha256(function.serialize().encode()).hexdigest()[:16]
    try:
        C = ca.CodeGenerator(name, {"with_header": False})
        f = function.wrap() if 0 else function
        C.add(f)
        src = C.dump()
    except Exception as e:
        return Native(function, False, str(e))
    p = "/tmp/" + name
    if not os.path.exists(p + ".so"):
        open(p + ".c", "w").write(src)
        subprocess.check_call(["gcc", "-O3", "-ffp-contract=off", "-fPIC", "-shared", p + ".c", "-o", p + ".so", "-lm"])
    return Native(ca.external(f.name(), p + ".so"), True, "")
