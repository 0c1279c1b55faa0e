//! Checks that a firmware's code has line tables, without which its lines are missing from coverage.

use crate::firmware_analysis::code_map::CodeMap;
use crate::firmware_analysis::error::FirmwareAnalysisError;
use crate::firmware_analysis::is_standard_library;
use platebench_rig::Symbols;

/// Fails if functions of the firmware have no line table. With `has_selection`, the user selects files,
/// so the check fails only if no function has one.
pub(crate) fn check_line_tables(
    map: &CodeMap,
    symbols: &Symbols,
    has_selection: bool,
) -> Result<(), FirmwareAnalysisError> {
    let mut without = Vec::new();
    let mut with = 0;
    for function in &map.functions {
        let mut code = map.instructions.range(function.range.clone()).map(|(&address, _)| address).peekable();
        if code.peek().is_none() {
            continue;
        }
        let mut has_lines = false;
        let mut is_own = false;
        for line in code.flat_map(|address| symbols.frames(address)).filter_map(|frame| frame.line) {
            has_lines = true;
            is_own = !is_standard_library(&line.file);
            if is_own {
                break;
            }
        }
        with += usize::from(is_own);
        if !has_lines && !is_runtime(&function.name, map.instructions.range(function.range.clone()).count()) {
            without.push(function.name.clone());
        }
    }
    if with > 0 && (without.is_empty() || has_selection) {
        return Ok(());
    }
    let total = without.len() + with;
    Err(FirmwareAnalysisError::NoLines { functions: without, total, compressed: symbols.has_compressed_lines() })
}

/// Start-up code in assembler of ST and of the crate `cortex-m-rt`.
const START_UP: [&str; 4] = ["Reset_Handler", "Reset", "HardFault", "HardFaultTrampoline"];

/// Start-up code of GCC. The C standard reserves names with an underscore for the implementation.
const COMPILER: [&str; 3] = ["deregister_tm_clones", "register_tm_clones", "frame_dummy"];

/// Functions of the C standard in `string.h`, `stdlib.h`, `stdio.h` and `setjmp.h`.
const LIBRARY: [&str; 41] = [
    "abort",
    "abs",
    "atoi",
    "atol",
    "bsearch",
    "calloc",
    "div",
    "exit",
    "fflush",
    "free",
    "labs",
    "ldiv",
    "longjmp",
    "malloc",
    "memchr",
    "memcmp",
    "memcpy",
    "memmove",
    "memset",
    "printf",
    "putchar",
    "puts",
    "qsort",
    "rand",
    "realloc",
    "setjmp",
    "snprintf",
    "sprintf",
    "srand",
    "sscanf",
    "strchr",
    "strcmp",
    "strcpy",
    "strlen",
    "strncmp",
    "strncpy",
    "strtof",
    "strtol",
    "vprintf",
    "vsnprintf",
    "vsprintf",
];

/// Functions of `math.h` and `complex.h` without their suffixes `f` and `l`.
const MATHEMATICS: [&str; 36] = [
    "acos", "asin", "atan", "atan2", "cabs", "carg", "ceil", "cexp", "cimag", "copysign", "cos", "creal", "exp",
    "exp2", "fabs", "finite", "floor", "fma", "fmax", "fmin", "fmod", "frexp", "hypot", "ldexp", "log", "log10",
    "log2", "lround", "pow", "round", "scalbn", "sin", "sqrt", "tan", "tanh", "trunc",
];

/// True for functions that are no code of the firmware's author. Distributions remove the line tables
/// of their libraries, and assemblers write none without an option.
fn is_runtime(name: &str, instructions: usize) -> bool {
    let math = |name: &str| MATHEMATICS.contains(&name);
    // A handler of one instruction is an endless loop.
    instructions <= 1
        || name.starts_with('_')
        || [&START_UP[..], &COMPILER, &LIBRARY].iter().any(|names| names.contains(&name))
        || math(name)
        || name.strip_suffix(['f', 'l']).is_some_and(math)
}
