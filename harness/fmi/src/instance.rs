//! Simulates a plate between communication points. Inputs are constant during a step, so the closed
//! form is exact for every step size.

use platebench_model::trace::read_text_file;
use platebench_plate::{ConditionProfiles, Conditions, Drive, Model, Plant, Plate, Profile, RawPlate, Time};
use std::f64::consts::TAU;
use std::path::Path;

/// Largest plate file, as for every TOML file that a user writes.
const MAX_PLATE_BYTES: u64 = 4 << 20;

/// Name of the plate file in the folder `resources` of the FMU.
pub(crate) const PLATE_FILE: &str = "plate.toml";

#[derive(Debug, thiserror::Error)]
pub enum InstanceError {
    #[error("{PLATE_FILE} of the FMU cannot be read: {0}")]
    Read(#[from] std::io::Error),
    #[error("{PLATE_FILE} of the FMU: {0}")]
    Parse(#[from] toml::de::Error),
    #[error("{PLATE_FILE} of the FMU: {0}")]
    Plate(#[from] platebench_plate::PlateError),
    #[error("the FMU has no variable with the value reference {0} for this function; see modelDescription.xml")]
    NoVariable(u32),
    #[error("{name} is {value}, expected {expected}")]
    Input { name: &'static str, value: f64, expected: &'static str },
    #[error(
        "the step begins at {from} s and is {step} s long, expected a step that begins at {at} s and is not negative"
    )]
    Step { from: f64, step: f64, at: f64 },
}

#[derive(Debug, Clone)]
pub struct Instance {
    plate: Plate,
    plant: Plant,
    inputs: [f64; INPUTS.len()],
    start_s: f64,
}

fn plant_at_rest(plate: &Plate) -> Plant {
    let scene =
        ConditionProfiles { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.0) };
    Plant::new(plate.clone(), scene, Model::Modal)
}

impl Instance {
    pub fn new(plate: Plate) -> Self {
        let inputs = [0.0, plate.omega0 / TAU, 0.0, 0.0];
        Self { plant: plant_at_rest(&plate), plate, inputs, start_s: 0.0 }
    }

    pub fn from_resources(folder: &Path) -> Result<Self, InstanceError> {
        let text = read_text_file(&folder.join(PLATE_FILE), MAX_PLATE_BYTES)?;
        Ok(Self::new(toml::from_str::<RawPlate>(&text)?.check()?))
    }

    pub(crate) fn reset(&mut self) {
        *self = Self::new(self.plate.clone());
    }

    pub(crate) fn start(&mut self, start_s: f64) {
        self.start_s = start_s;
        self.plant = plant_at_rest(&self.plate);
    }

    fn time_s(&self) -> f64 {
        self.start_s + self.plant.time().seconds()
    }

    pub(crate) fn value(&self, reference: u32) -> Result<f64, InstanceError> {
        if reference == TIME_REFERENCE {
            return Ok(self.time_s());
        }
        let index = reference as usize - 1;
        let state = self.plant.state();
        let outputs: [f64; OUTPUTS.len()] = [state.w.re, state.w.im, state.u.re, state.u.im, state.amplitude()];
        let value = self.inputs.iter().chain(&outputs).nth(index);
        value.copied().ok_or(InstanceError::NoVariable(reference))
    }

    pub(crate) fn set_input(&mut self, reference: u32, value: f64) -> Result<(), InstanceError> {
        let index = (reference as usize).wrapping_sub(1);
        let Some((input, variable)) = self.inputs.get_mut(index).zip(INPUTS.get(index)) else {
            return Err(InstanceError::NoVariable(reference));
        };
        let expected = match variable.name {
            "temperature" => "a finite number",
            "frequency" => "a finite number above 0",
            _ => "a finite number that is not negative",
        };
        let is_valid = match variable.name {
            "temperature" => true,
            "frequency" => value > 0.0,
            _ => value >= 0.0,
        };
        if !value.is_finite() || !is_valid {
            return Err(InstanceError::Input { name: variable.name, value, expected });
        }
        *input = value;
        Ok(())
    }

    /// Communication points are rounded to whole nanoseconds.
    pub(crate) fn step(&mut self, from_s: f64, step_s: f64) -> Result<(), InstanceError> {
        let invalid = || InstanceError::Step { from: from_s, step: step_s, at: self.time_s() };
        let from = Time::from_seconds(from_s - self.start_s).ok_or_else(invalid)?;
        let end = Time::from_seconds(from_s - self.start_s + step_s).ok_or_else(invalid)?;
        if from != self.plant.time() || end < from {
            return Err(invalid());
        }
        let [vpp, frequency_hz, finger_force_n, temperature_offset_k] = self.inputs;
        let conditions = Conditions { temperature_offset_k, finger_force_n };
        if self.plant.conditions_at(from) != conditions {
            self.plant.hold_conditions(conditions);
        }
        self.plant.set_drive(Drive { vpp, omega: TAU * frequency_hz });
        self.plant.advance(end, &[], &mut Vec::new());
        Ok(())
    }
}

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

#[cfg(test)]
mod tests {
    use super::*;

    const PLATE: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");

    fn instance() -> Instance {
        let plate = PLATE.split_once('\n').unwrap().1;
        Instance::new(toml::from_str::<RawPlate>(plate).unwrap().check().unwrap())
    }

    fn amplitude_after(steps: u32, length_s: f64) -> f64 {
        let mut instance = instance();
        instance.set_input(u32::try_from(input_reference(0)).unwrap(), 286.5).unwrap();
        for step in 0..steps {
            instance.step(f64::from(step) * length_s, length_s).unwrap();
        }
        instance.value(u32::try_from(output_reference(4)).unwrap()).unwrap()
    }

    #[test]
    fn the_step_size_does_not_change_the_result() {
        let coarse = amplitude_after(1, 60e-3);
        assert!((coarse - 2.0).abs() < 1e-3, "{coarse}");
        for (steps, length_s) in [(60, 1e-3), (600, 1e-4), (24, 2.5e-3)] {
            let difference = amplitude_after(steps, length_s) - coarse;
            assert!(difference.abs() < 1e-12, "{length_s}: {difference}");
        }
    }

    #[test]
    fn rejects_wrong_inputs_and_steps() {
        let mut instance = instance();
        assert!(matches!(instance.set_input(1, -1.0), Err(InstanceError::Input { name: "drive", .. })));
        assert!(matches!(instance.set_input(2, 0.0), Err(InstanceError::Input { name: "frequency", .. })));
        assert!(matches!(instance.set_input(4, f64::NAN), Err(InstanceError::Input { name: "temperature", .. })));
        assert!(matches!(instance.set_input(5, 0.0), Err(InstanceError::NoVariable(5))));
        assert!(matches!(instance.value(10), Err(InstanceError::NoVariable(10))));
        assert!(matches!(instance.step(1e-3, 1e-3), Err(InstanceError::Step { .. })));
        assert!(matches!(instance.step(0.0, -1e-3), Err(InstanceError::Step { .. })));
        instance.step(0.0, 1e-3).unwrap();
        assert_eq!(instance.value(0).unwrap(), 1e-3);
        instance.reset();
        instance.step(0.0, 1e-3).unwrap();
    }
}
