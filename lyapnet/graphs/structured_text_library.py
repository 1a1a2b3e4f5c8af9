"""Functions of structured text of IEC 61131-3, and others written in it: tanh, floor, linear systems, and so on."""

import re
import textwrap
from collections.abc import Iterable

STANDARD = {  # function of the C library ↦ standard function of IEC 61131-3
    "acos": "ACOS", "asin": "ASIN", "atan": "ATAN", "cos": "COS", "fabs": "ABS", "larger": "MAX",
    "log": "LN", "log10": "LOG", "pow": "EXPT", "sin": "SIN", "smaller": "MIN", "sqrt": "SQRT", "tan": "TAN",
}  # fmt: skip
FURTHER = {  # further function ↦ its operands, and its body, in which @ is the name of the function
    "exp": ("a", "@ := EXP(MIN(a, 700.0));"),  # a controller may stop at an overflow; see LARGEST_EXPONENT
    "expm1": ("a", """
        e := EXP(a);
        IF e = 1.0 THEN
            @ := a;
        ELSIF e - 1.0 = -1.0 THEN
            @ := -1.0;
        ELSE
            @ := (e - 1.0) * a / LN(e);
        END_IF;
    """),
    "log1p": ("a", """
        e := 1.0 + a;
        IF e = 1.0 THEN
            @ := a;
        ELSE
            @ := LN(e) * a / (e - 1.0);
        END_IF;
    """),
    "tanh": ("a", """
        e := expm1(-2.0 * ABS(a));
        @ := -e / (2.0 + e);
        IF a < 0.0 THEN
            @ := -@;
        END_IF;
    """),
    "sinh": ("a", """
        e := expm1(ABS(a));
        @ := 0.5 * (e + e / (1.0 + e));
        IF a < 0.0 THEN
            @ := -@;
        END_IF;
    """),
    "cosh": ("a", "@ := 0.5 * (EXP(a) + EXP(-a));"),
    "asinh": ("a", """
        @ := log1p(ABS(a) + a * a / (1.0 + SQRT(1.0 + a * a)));
        IF a < 0.0 THEN
            @ := -@;
        END_IF;
    """),
    "acosh": ("a", "@ := LN(a + SQRT(a * a - 1.0));"),
    "atanh": ("a", "@ := 0.5 * log1p(2.0 * a / (1.0 - a));"),
    "exp2": ("a", "@ := EXP(0.6931471805599453 * a);"),
    "log2": ("a", "@ := LN(a) / 0.6931471805599453;"),
    "floor": ("a", """
        @ := a;
        IF ABS(a) < 9.0E15 THEN
            e := 0.0;
            IF ABS(a) > 1.0E9 THEN
                e := 1.0E9 * DINT_TO_LREAL(LREAL_TO_DINT(a / 1.0E9));
            END_IF;
            @ := e + DINT_TO_LREAL(LREAL_TO_DINT(a - e));
            IF @ > a THEN
                @ := @ - 1.0;
            END_IF;
        END_IF;
    """),
    "ceil": ("a", "@ := -floor(-a);"),
    "trunc": ("a", """
        @ := floor(ABS(a));
        IF a < 0.0 THEN
            @ := -@;
        END_IF;
    """),
    "fmod": ("a, b", """
        @ := a - b * trunc(a / b);
        IF @ * a < 0.0 THEN
            IF a > 0.0 THEN
                @ := @ + ABS(b);
            ELSE
                @ := @ - ABS(b);
            END_IF;
        END_IF;
    """),  # a / b may be rounded up to a whole number, as below
    "remainder_of": ("a, b", """
        @ := a - b * floor(a / b);
        IF @ * b < 0.0 THEN
            @ := @ + b;
        END_IF;
    """),
    "hypot": ("a, b", "@ := SQRT(a * a + b * b);"),
    "atan2": ("a, b", """
        IF (a = 0.0) AND (b = 0.0) THEN
            @ := 0.0;
        ELSIF ABS(b) >= ABS(a) THEN
            @ := ATAN(a / b);
            IF b < 0.0 THEN
                IF a >= 0.0 THEN
                    @ := @ + 3.141592653589793;
                ELSE
                    @ := @ - 3.141592653589793;
                END_IF;
            END_IF;
        ELSE
            @ := 1.5707963267948966 - ATAN(b / a);
            IF a < 0.0 THEN
                @ := @ - 3.141592653589793;
            END_IF;
        END_IF;
    """),
    "erf": ("a", """
        IF ABS(a) > 6.0 THEN
            @ := 1.0;
            IF a < 0.0 THEN
                @ := -1.0;
            END_IF;
        ELSE
            e := a;
            @ := a;
            FOR k := 1 TO 150 DO
                e := e * 2.0 * a * a / (2.0 * DINT_TO_LREAL(k) + 1.0);
                @ := @ + e;
            END_FOR;
            @ := 1.1283791670955126 * EXP(-a * a) * @;
        END_IF;
    """),
    "erfc": ("a", "@ := 1.0 - erf(a);"),
}  # fmt: skip
LARGEST_EXPONENT = {"LREAL": "700.0", "REAL": "87.0"}  # largest a for which exp(a) is computed

ELIMINATION = """determinant := 1.0;
FOR j0 := 0 TO {rows} DO
    best := j0;
    FOR j1 := j0 + 1 TO {rows} DO
        IF ABS({A}[j1 * {n} + j0]) > ABS({A}[best * {n} + j0]) THEN
            best := j1;
        END_IF;
    END_FOR;
    IF best <> j0 THEN
        FOR j1 := 0 TO {rows} DO
            factor := {A}[j0 * {n} + j1];
            {A}[j0 * {n} + j1] := {A}[best * {n} + j1];
            {A}[best * {n} + j1] := factor;
        END_FOR;
@exchange_b
        determinant := -determinant;
    END_IF;
    determinant := determinant * {A}[j0 * {n} + j0];
    IF {A}[j0 * {n} + j0] <> 0.0 THEN
        FOR j1 := j0 + 1 TO {rows} DO
            factor := {A}[j1 * {n} + j0] / {A}[j0 * {n} + j0];
            FOR j2 := j0 TO {rows} DO
                {A}[j1 * {n} + j2] := {A}[j1 * {n} + j2] - factor * {A}[j0 * {n} + j2];
            END_FOR;
@eliminate_b
        END_FOR;
    END_IF;
END_FOR;
"""
EXCHANGE_B = """        FOR j1 := 0 TO {columns} DO
            factor := {b}[j0 * {k} + j1];
            {b}[j0 * {k} + j1] := {b}[best * {k} + j1];
            {b}[best * {k} + j1] := factor;
        END_FOR;"""
ELIMINATE_B = """            FOR j2 := 0 TO {columns} DO
                {b}[j1 * {k} + j2] := {b}[j1 * {k} + j2] - factor * {b}[j0 * {k} + j2];
            END_FOR;"""
SUBSTITUTE = """FOR j2 := 0 TO {columns} DO
    FOR j0 := {rows} TO 0 BY -1 DO
        FOR j1 := j0 + 1 TO {rows} DO
            {b}[j0 * {k} + j2] := {b}[j0 * {k} + j2] - {A}[j0 * {n} + j1] * {b}[j1 * {k} + j2];
        END_FOR;
        {b}[j0 * {k} + j2] := {b}[j0 * {k} + j2] / {A}[j0 * {n} + j0];
    END_FOR;
END_FOR;
"""


def further_functions(used: Iterable[str], name: str) -> list[str]:
    """The further functions that the block calls, and those that these call, each before it is called."""
    needed = set(used)
    for function in reversed(FURTHER):  # a function calls only earlier ones
        if function in needed:
            needed |= {other for other in FURTHER if re.search(rf"\b{other}\(", FURTHER[function][1])}
    texts = list[str]()
    for function, (operands, body) in FURTHER.items():
        if function in needed:
            for other in FURTHER:
                body = re.sub(rf"\b{other}\(", f"{name}_{other}(", body)
            body = textwrap.indent(textwrap.dedent(body).strip(), "    ").replace("@", f"{name}_{function}")
            own = [f"    {each} : {kind};" for each, kind in (("e", "LREAL"), ("k", "DINT"))
                   if re.search(rf"\b{each}\b", body)]  # fmt: skip
            local = ["VAR", *own, "END_VAR"] if own else []
            texts += [f"FUNCTION {name}_{function} : LREAL", "VAR_INPUT", f"    {operands} : LREAL;", "END_VAR", *local,
                      body, "END_FUNCTION\n"]  # fmt: skip
    return texts
