"""A Functional Mock-up Unit for co-simulation (FMI 2.0 or 3.0) of the law or the loop, with source and binary."""

import hashlib
import platform
import re
import sys
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from lyapnet import __version__
from lyapnet.controller.controller import Controller
from lyapnet.exchange.export.c import STRICT, Style, compile_c
from lyapnet.exchange.export.c_loop import LoopTraces
from lyapnet.exchange.export.law import Law

VERSIONS = ("2.0", "3.0")
BINARY = (*STRICT, "-O3", "-shared", "-fPIC")
SOURCES = ("fmu.c", "policy.c")
PLATFORMS = {  # (system, machine) ↦ the folder of its binaries in FMI 2.0, in FMI 3.0, and how their names end
    ("linux", "x86_64"): ("linux64", "x86_64-linux", ".so"),
    ("linux", "aarch64"): ("aarch64-linux", "aarch64-linux", ".so"),
    ("darwin", "x86_64"): ("darwin64", "x86_64-darwin", ".dylib"),
    ("darwin", "arm64"): ("aarch64-darwin", "aarch64-darwin", ".dylib"),
}


class Variable(NamedTuple):
    """An input, parameter or output of a unit."""

    name: str  # an identifier
    about: str  # its description
    unit: str
    causality: str  # input, parameter or output
    start: float | None = None


def variables_of(controller: Controller, law: Law, loop: LoopTraces | None) -> list[Variable]:
    """Inputs x and, for a family, parameters; or for a loop, its readings and settings as inputs. The outputs are u.

    The value reference of a variable is its position in this list, from 1 on; 0 is time, and the last one is the code.
    """
    system, n = controller.system, len(law.arguments["x"])
    centre, given = controller.initial_states.center.tolist(), list[tuple[str, str, str, float | None]]()
    if loop is None:
        states = zip(system.state_names, system.state_units, centre, strict=True)
        given = [(name, unit, "input" if i < n else "parameter", at) for i, (name, unit, at) in enumerate(states)]
    else:
        outputs = loop.loop.outputs
        first = outputs(loop.loop.problem.initial_states.center).tolist()
        given = [(*each, "input", at) for *each, at in zip(outputs.names, outputs.units, first, strict=True)]
        of = list(loop.loop.settings.values())
        given += [(system.state_names[i], system.state_units[i], "input", centre[i]) for i in of]
    given += [
        (name, unit, "output", None) for name, unit in zip(system.control_names, system.control_units, strict=True)
    ]
    taken, found = {"time", "code"}, list[Variable]()
    for k, (name, unit, causality, start) in enumerate(given):
        found.append(Variable(_identifier(name, f"{causality}{k + 1}", taken), name, unit, causality, start))
    return found


def _identifier(name: str, otherwise: str, taken: set[str]) -> str:
    """An identifier made of a name, or `otherwise` if the name begins with no letter, that is not taken yet."""
    short = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    short = short if re.match(r"[A-Za-z]", short) else otherwise
    unique, k = short, 2
    while unique in taken:
        unique, k = f"{short}_{k}", k + 1
    taken.add(unique)
    return unique


def write_fmu(
    path: Path, version: str, sources: Mapping[str, str], variables: Sequence[Variable], style: Style,
    controller: Controller, looped: bool, settings: int, draft: Path,
) -> None:  # fmt: skip
    """Write a unit: its description, its source and, on machines in PLATFORMS, a binary.

    Args:
        version: one of VERSIONS.
        sources: the texts of policy.h and policy.c.
        variables: those of variables_of.
        style: the names and the precision of the sources.
        looped: whether the sources have a loop, whose inputs are readings.
        settings: the number of inputs, the last ones, that are settings of a family.
        draft: an empty folder.

    Raises:
        ExportError: the C cannot be compiled.
    """
    text = _adapter(version, variables, style, looped, settings, controller.horizon.dt)
    token = hashlib.sha256((text + sources["policy.c"]).encode()).hexdigest()[:32]
    files = {
        "policy.h": sources["policy.h"], "policy.c": sources["policy.c"], "fmu.c": text.replace("@TOKEN", token),
    }  # fmt: skip
    for name, content in files.items():
        (draft / name).write_text(content, encoding="utf-8")
    compile_c([draft / name for name in SOURCES], draft / "checked.so", BINARY)
    describe = _description_2 if version == "2.0" else _description_3
    content = {f"sources/{name}": text.encode() for name, text in files.items()}
    content["modelDescription.xml"] = describe(path.stem, token, variables, style.name, controller).encode()
    if version == "3.0":
        content["sources/buildDescription.xml"] = _build_description(style.name).encode()
    if (place := PLATFORMS.get((sys.platform, platform.machine()))) is not None:
        folder, ending = place[VERSIONS.index(version)], place[2]
        content[f"binaries/{folder}/{style.name}{ending}"] = (draft / "checked.so").read_bytes()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)


def _attributes(**given: object) -> str:
    """Attributes of XML, without those that are None; characters that XML does not allow become blanks."""
    texts = {
        key: re.sub(r"[\x00-\x1f\ufffe\uffff]", " ", str(value)) for key, value in given.items() if value is not None
    }
    return " ".join(f"{key}={quoteattr(text)}" for key, text in texts.items())


def _units(variables: Iterable[Variable]) -> str:
    units = dict.fromkeys(variable.unit for variable in variables if variable.unit)
    if not units:
        return ""
    return (
        "  <UnitDefinitions>\n"
        + "".join(f"    <Unit {_attributes(name=unit)}/>\n" for unit in units)
        + "  </UnitDefinitions>\n"
    )


def _experiment(controller: Controller) -> str:
    horizon = controller.horizon
    return f"  <DefaultExperiment {_attributes(startTime=0.0, stopTime=horizon.duration, stepSize=horizon.dt)}/>\n"


ABOUT = "A control law of lyapnet; u is made of the inputs at the beginning of a step, and held for the internal step."
TIME = {"name": "time", "valueReference": 0, "causality": "independent", "variability": "continuous"}
CODE = "0, or a sum of the numbers in policy.h: whether u is finite, and x where the law was compared"


def _description_2(title: str, token: str, variables: Sequence[Variable], name: str, controller: Controller) -> str:
    """modelDescription.xml of FMI 2.0."""
    rows = [f"    <ScalarVariable {_attributes(**TIME)}><Real/></ScalarVariable>\n"]
    for k, each in enumerate(variables, 1):
        about = {"name": each.name, "valueReference": k, "causality": each.causality, "description": each.about}
        about["variability"], real = _variability(each), _attributes(unit=each.unit or None, start=each.start)
        rows.append(f"    <ScalarVariable {_attributes(**about)}><Real {real}/></ScalarVariable>\n")
    about = {"name": "code", "valueReference": len(variables) + 1, "causality": "output", "description": CODE}
    rows.append(f"    <ScalarVariable {_attributes(**about, variability='discrete')}><Integer/></ScalarVariable>\n")
    unknowns = "".join(f'      <Unknown index="{k + 1}"/>\n' for k in _outputs(variables))
    files = "".join(f"      <File {_attributes(name=file)}/>\n" for file in SOURCES)
    head = _attributes(
        fmiVersion="2.0", modelName=title, guid=token, description=ABOUT, generationTool=f"lyapnet {__version__}",
        variableNamingConvention="flat",
    )  # fmt: skip
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription {head}>\n'
        f"  <CoSimulation {_attributes(modelIdentifier=name, canHandleVariableCommunicationStepSize='true')}>\n"
        f"    <SourceFiles>\n{files}    </SourceFiles>\n  </CoSimulation>\n{_units(variables)}{_experiment(controller)}"
        f"  <ModelVariables>\n{''.join(rows)}  </ModelVariables>\n  <ModelStructure>\n    <Outputs>\n{unknowns}"
        f"    </Outputs>\n    <InitialUnknowns>\n{unknowns}    </InitialUnknowns>\n  </ModelStructure>\n"
        "</fmiModelDescription>\n"
    )


def _description_3(title: str, token: str, variables: Sequence[Variable], name: str, controller: Controller) -> str:
    """modelDescription.xml of FMI 3.0."""
    rows = [f"    <Float64 {_attributes(**TIME)}/>\n"]
    for k, each in enumerate(variables, 1):
        about = {"name": each.name, "valueReference": k, "causality": each.causality, "description": each.about}
        about |= {"variability": _variability(each), "unit": each.unit or None, "start": each.start}
        rows.append(f"    <Float64 {_attributes(**about)}/>\n")
    about = {"name": "code", "valueReference": len(variables) + 1, "causality": "output", "description": CODE}
    rows.append(f"    <Int32 {_attributes(**about, variability='discrete')}/>\n")
    structure = "".join(
        f'    <{kind} valueReference="{k}"/>\n' for kind in ("Output", "InitialUnknown") for k in _outputs(variables)
    )
    head = _attributes(
        fmiVersion="3.0", modelName=title, instantiationToken=token, description=ABOUT,
        generationTool=f"lyapnet {__version__}", variableNamingConvention="flat",
    )  # fmt: skip
    kind = _attributes(
        modelIdentifier=name, canHandleVariableCommunicationStepSize="true", fixedInternalStepSize=controller.horizon.dt
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription {head}>\n  <CoSimulation {kind}/>\n'
        f"{_units(variables)}{_experiment(controller)}  <ModelVariables>\n{''.join(rows)}  </ModelVariables>\n"
        f"  <ModelStructure>\n{structure}  </ModelStructure>\n</fmiModelDescription>\n"
    )


def _variability(variable: Variable) -> str:
    return {"input": "continuous", "parameter": "tunable", "output": "discrete"}[variable.causality]


def _outputs(variables: Sequence[Variable]) -> list[int]:
    """The value references of the outputs."""
    return [k for k, each in enumerate(variables, 1) if each.causality == "output"] + [len(variables) + 1]


def _build_description(name: str) -> str:
    files = "".join(f'      <SourceFile name="{file}"/>\n' for file in SOURCES)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{name}">\n    <SourceFileSet language="C99">\n{files}'
        '    </SourceFileSet>\n    <Library name="m" external="true"/>\n  </BuildConfiguration>\n'
        "</fmiBuildDescription>\n"
    )


def _adapter(version: str, variables: Sequence[Variable], style: Style, looped: bool, settings: int, dt: float) -> str:
    """fmu.c: the functions of the standard, which call policy.c."""
    given = [each for each in variables if each.causality != "output"]
    inputs = sum(each.causality == "input" for each in given)
    parameter = ", p" if len(given) > inputs else ""
    start = ", ".join(repr(float(each.start or 0.0)) for each in given)
    if looped:
        memory, reset = f"    {style.name}_loop loop;\n", f"    {style.name}_reset(&unit->loop);\n"
        call = f"{style.name}_step(&unit->loop, x, {f'x + {inputs - settings}, ' if settings else ''}u)"
    else:
        memory, reset = "", ""
        call = f"{style.name}_control(({style.real})((double)unit->samples * DT), x{parameter}, u)"
    words = {
        "REAL": style.real, "N": inputs, "GIVEN": len(given), "M": f"{style.macro}_CONTROLS",
        "START": start, "MEMORY": memory, "RESET": reset, "CALL": call, "LAST": len(variables) + 1,
        "PARAMETERS": f"    {style.real} p[{len(given) - inputs}];\n"
        f"    for (int i = 0; i < {len(given) - inputs}; i++) p[i] = ({style.real})unit->given[{inputs} + i];\n"
        if parameter else "",
        "DT": repr(dt),
    }  # fmt: skip
    text = UNIT + (FMI_2 if version == "2.0" else FMI_3)
    return re.sub(r"@([A-Z]+)", lambda word: str(words.get(word[1], word[0])), text)


# During a step, u follows from the inputs that were set before it. Before the first step, u is computed from the inputs
# at the start, and the loop does not change.
UNIT = """/* A unit of the Functional Mock-up Interface around policy.c. */
#include <stdlib.h>
#include <string.h>

#include "policy.h"

#define DT @DT

typedef struct {
    double start, time, given[@GIVEN], u[@M];
    int code;
    unsigned long samples;  /* since the start */
@MEMORY} unit_t;

static void reset(unit_t *unit)
{
    static const double given[@GIVEN] = {@START};
    memset(unit, 0, sizeof *unit);
    memcpy(unit->given, given, sizeof given);
@RESET}

static unit_t *instantiate(const char *token)
{
    if (token == NULL || strcmp(token, "@TOKEN") != 0) return NULL;
    unit_t *unit = malloc(sizeof *unit);
    if (unit != NULL) reset(unit);
    return unit;
}

static void sample(unit_t *unit)
{
    @REAL x[@N], u[@M];
    for (int i = 0; i < @N; i++) x[i] = (@REAL)unit->given[i];
@PARAMETERS    unit->code = @CALL;
    for (int i = 0; i < @M; i++) unit->u[i] = u[i];
    unit->samples++;
}

/* Samples are taken at the multiples of DT from the start, those of [time, time + step) with the inputs as they are. */
static int advance(unit_t *unit, double time, double step)
{
    double room = 1e-6 * DT;
    if (!(step >= 0) || !(time >= unit->time - room && time <= unit->time + room)) return 0;
    while (unit->start + (double)unit->samples * DT < time + step - room) sample(unit);
    unit->time = time + step;
    return 1;
}

static void preview(unit_t *unit)
{
    if (unit->samples > 0) return;
    unit_t copy = *unit;
    sample(&copy);
    memcpy(unit->u, copy.u, sizeof copy.u);
    unit->code = copy.code;
}

static int get(unit_t *unit, const unsigned int *which, size_t n, double *values)
{
    preview(unit);
    for (size_t i = 0; i < n; i++) {
        if (which[i] == 0) values[i] = unit->time;
        else if (which[i] <= @GIVEN) values[i] = unit->given[which[i] - 1];
        else if (which[i] < @LAST) values[i] = unit->u[which[i] - 1 - @GIVEN];
        else return 0;
    }
    return 1;
}

static int set(unit_t *unit, const unsigned int *which, size_t n, const double *values)
{
    for (size_t i = 0; i < n; i++) {
        if (which[i] == 0 || which[i] > @GIVEN) return 0;
        unit->given[which[i] - 1] = values[i];
    }
    return 1;
}

static int get_code(unit_t *unit, const unsigned int *which, size_t n, int *values)
{
    preview(unit);
    for (size_t i = 0; i < n; i++) {
        if (which[i] != @LAST) return 0;
        values[i] = unit->code;
    }
    return 1;
}

enum { OK = 0, ERROR = 3 };
"""

FMI_2 = """
/* FMI 2.0 for co-simulation. */
typedef struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
} callbacks_t;

#define STATUS(done) ((done) ? OK : ERROR)
/* What this unit does not offer; the description does not announce it. */
#define NONE(name) int name(void *unit) { (void)unit; return ERROR; }
#define EMPTY(name, type) \\
    int name(void *unit, const unsigned int *which, size_t n, type values) \\
    { (void)unit; (void)which; (void)values; return STATUS(n == 0); }

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

int fmi2SetDebugLogging(void *unit, int on, size_t n, const char *const categories[])
{
    (void)unit; (void)on; (void)n; (void)categories;
    return OK;
}

void *fmi2Instantiate(const char *name, int kind, const char *token, const char *resources,
                      const callbacks_t *callbacks, int visible, int log)
{
    (void)name; (void)resources; (void)callbacks; (void)visible; (void)log;
    return kind == 1 ? instantiate(token) : NULL;
}

void fmi2FreeInstance(void *unit) { free(unit); }

int fmi2SetupExperiment(void *unit, int tolerates, double tolerance, double start, int stops, double stop)
{
    (void)tolerates; (void)tolerance; (void)stops; (void)stop;
    ((unit_t *)unit)->start = ((unit_t *)unit)->time = start;
    return OK;
}

int fmi2EnterInitializationMode(void *unit) { (void)unit; return OK; }
int fmi2ExitInitializationMode(void *unit) { (void)unit; return OK; }
int fmi2Terminate(void *unit) { (void)unit; return OK; }
int fmi2Reset(void *unit) { reset(unit); return OK; }

int fmi2GetReal(void *unit, const unsigned int *which, size_t n, double *values)
{
    return STATUS(get(unit, which, n, values));
}

int fmi2SetReal(void *unit, const unsigned int *which, size_t n, const double *values)
{
    return STATUS(set(unit, which, n, values));
}

int fmi2GetInteger(void *unit, const unsigned int *which, size_t n, int *values)
{
    return STATUS(get_code(unit, which, n, values));
}

EMPTY(fmi2SetInteger, const int *)
EMPTY(fmi2GetBoolean, int *)
EMPTY(fmi2SetBoolean, const int *)
EMPTY(fmi2GetString, const char **)
EMPTY(fmi2SetString, const char *const *)

int fmi2DoStep(void *unit, double time, double step, int forgets)
{
    (void)forgets;
    return STATUS(advance(unit, time, step));
}

NONE(fmi2CancelStep)
NONE(fmi2GetFMUstate)
NONE(fmi2SetFMUstate)
NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize)
NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative)
NONE(fmi2SetRealInputDerivatives)
NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2GetStatus)
NONE(fmi2GetRealStatus)
NONE(fmi2GetIntegerStatus)
NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)
"""

FMI_3 = """
/* FMI 3.0 for co-simulation. */
#include <stdbool.h>
#include <stdint.h>

#define STATUS(done) ((done) ? OK : ERROR)
/* What this unit does not offer; the description does not announce it. */
#define NONE(name) int name(void *unit) { (void)unit; return ERROR; }
#define EMPTY(kind, type) \\
    int fmi3Get##kind(void *unit, const uint32_t *which, size_t n, type *values, size_t m) \\
    { (void)unit; (void)which; (void)values; (void)m; return STATUS(n == 0); } \\
    int fmi3Set##kind(void *unit, const uint32_t *which, size_t n, const type *values, size_t m) \\
    { (void)unit; (void)which; (void)values; (void)m; return STATUS(n == 0); }

const char *fmi3GetVersion(void) { return "3.0"; }

int fmi3SetDebugLogging(void *unit, bool on, size_t n, const char *const categories[])
{
    (void)unit; (void)on; (void)n; (void)categories;
    return OK;
}

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool log,
                                  bool events, bool early, const uint32_t *intermediate, size_t n, void *environment,
                                  void (*message)(void *, int, const char *, const char *),
                                  void (*update)(void *, double, bool, bool, bool, bool, bool *, double *))
{
    (void)name; (void)resources; (void)visible; (void)log; (void)events; (void)early; (void)intermediate; (void)n;
    (void)environment; (void)message; (void)update;
    return instantiate(token);
}

void *fmi3InstantiateModelExchange(const char *name) { (void)name; return NULL; }
void *fmi3InstantiateScheduledExecution(const char *name) { (void)name; return NULL; }
void fmi3FreeInstance(void *unit) { free(unit); }

int fmi3EnterInitializationMode(void *unit, bool tolerates, double tolerance, double start, bool stops, double stop)
{
    (void)tolerates; (void)tolerance; (void)stops; (void)stop;
    ((unit_t *)unit)->start = ((unit_t *)unit)->time = start;
    return OK;
}

int fmi3ExitInitializationMode(void *unit) { (void)unit; return OK; }
int fmi3EnterStepMode(void *unit) { (void)unit; return OK; }
int fmi3Terminate(void *unit) { (void)unit; return OK; }
int fmi3Reset(void *unit) { reset(unit); return OK; }

int fmi3GetFloat64(void *unit, const uint32_t *which, size_t n, double *values, size_t m)
{
    return STATUS(n == m && get(unit, which, n, values));
}

int fmi3SetFloat64(void *unit, const uint32_t *which, size_t n, const double *values, size_t m)
{
    return STATUS(n == m && set(unit, which, n, values));
}

int fmi3GetInt32(void *unit, const uint32_t *which, size_t n, int32_t *values, size_t m)
{
    return STATUS(n == m && get_code(unit, which, n, values));
}

int fmi3SetInt32(void *unit, const uint32_t *which, size_t n, const int32_t *values, size_t m)
{
    (void)unit; (void)which; (void)values; (void)m;
    return STATUS(n == 0);
}

EMPTY(Float32, float)
EMPTY(Int8, int8_t)
EMPTY(UInt8, uint8_t)
EMPTY(Int16, int16_t)
EMPTY(UInt16, uint16_t)
EMPTY(UInt32, uint32_t)
EMPTY(Int64, int64_t)
EMPTY(UInt64, uint64_t)
EMPTY(Boolean, bool)

int fmi3GetString(void *unit, const uint32_t *which, size_t n, const char **values, size_t m)
{
    (void)unit; (void)which; (void)values; (void)m;
    return STATUS(n == 0);
}

int fmi3SetString(void *unit, const uint32_t *which, size_t n, const char *const *values, size_t m)
{
    (void)unit; (void)which; (void)values; (void)m;
    return STATUS(n == 0);
}

int fmi3DoStep(void *unit, double time, double step, bool forgets, bool *event, bool *ends, bool *early, double *last)
{
    (void)forgets;
    *event = *ends = *early = false;
    int done = advance(unit, time, step);
    *last = ((unit_t *)unit)->time;
    return STATUS(done);
}

NONE(fmi3EnterEventMode)
NONE(fmi3GetBinary)
NONE(fmi3SetBinary)
NONE(fmi3GetClock)
NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetVariableDependencies)
NONE(fmi3GetFMUState)
NONE(fmi3SetFMUState)
NONE(fmi3FreeFMUState)
NONE(fmi3SerializedFMUStateSize)
NONE(fmi3SerializeFMUState)
NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetAdjointDerivative)
NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode)
NONE(fmi3GetIntervalDecimal)
NONE(fmi3GetIntervalFraction)
NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction)
NONE(fmi3SetIntervalDecimal)
NONE(fmi3SetIntervalFraction)
NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction)
NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3UpdateDiscreteStates)
NONE(fmi3EnterContinuousTimeMode)
NONE(fmi3CompletedIntegratorStep)
NONE(fmi3SetTime)
NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives)
NONE(fmi3GetEventIndicators)
NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates)
NONE(fmi3GetNumberOfEventIndicators)
NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3GetOutputDerivatives)
NONE(fmi3ActivateModelPartition)
"""
