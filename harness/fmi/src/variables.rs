//! Lists inputs and outputs of the FMU.

/// Real variable. Value reference 0 is the time, then come the inputs, then the outputs.
#[derive(Debug, Clone, Copy)]
pub struct Variable {
    pub name: &'static str,
    pub unit: &'static str,
    pub meaning: &'static str,
}

pub(crate) const TIME_REFERENCE: u32 = 0;

/// The frequency starts at the resonance of the plate. The other inputs start at 0.
pub const INPUTS: [Variable; 4] = [
    Variable { name: "drive", unit: "V", meaning: "drive voltage, peak to peak, constant during a step" },
    Variable { name: "frequency", unit: "Hz", meaning: "excitation frequency, constant during a step" },
    Variable { name: "force", unit: "N", meaning: "normal force of the finger, constant during a step" },
    Variable {
        name: "temperature",
        unit: "K",
        meaning: "temperature above the plate's reference temperature, constant during a step",
    },
];

pub const OUTPUTS: [Variable; 5] = [
    Variable { name: "Wd", unit: "um", meaning: "in-phase component of the vibration W, peak to peak" },
    Variable { name: "Wq", unit: "um", meaning: "quadrature component of the vibration W, peak to peak" },
    Variable { name: "Ud", unit: "um/s", meaning: "real part of U = W' + jωW" },
    Variable { name: "Uq", unit: "um/s", meaning: "imaginary part of U = W' + jωW" },
    Variable { name: "amplitude", unit: "um", meaning: "amplitude |W|, peak to peak" },
];

pub(crate) fn input_reference(index: usize) -> usize {
    index + 1
}

pub(crate) fn output_reference(index: usize) -> usize {
    INPUTS.len() + 1 + index
}
