//! Implements the C interface of FMI 3.0 for co-simulation. Source: `fmi3FunctionTypes.h` of the
//! standard.
//!
//! All variables are real numbers. Functions for other types and for event mode return an error.

#![allow(unsafe_code, non_snake_case, unreachable_pub, reason = "the C interface of the standard")]
#![allow(clippy::missing_safety_doc, reason = "the standard states what a caller must guarantee")]
#![allow(clippy::fn_params_excessive_bools, reason = "the signatures of the standard")]

use crate::fmu_file::INSTANTIATION_TOKEN;
use crate::instance::{Instance, InstanceError};
use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::path::Path;
use std::{ptr, slice};

const OK: c_int = 0;
const ERROR: c_int = 3;

type LogMessage = unsafe extern "C" fn(*mut c_void, c_int, *const c_char, *const c_char);

struct Component {
    instance: Instance,
    environment: *mut c_void,
    log: Option<LogMessage>,
}

impl Component {
    fn report(&self, result: Result<(), InstanceError>) -> c_int {
        let Err(error) = result else { return OK };
        // SAFETY: the caller guarantees that its function and environment outlive the instance.
        unsafe { log_error(self.log, self.environment, &error.to_string()) };
        ERROR
    }
}

/// # Safety
/// `log` must accept `environment`.
unsafe fn log_error(log: Option<LogMessage>, environment: *mut c_void, message: &str) {
    if let (Some(log), Ok(message)) = (log, CString::new(message)) {
        // SAFETY: both texts end with a zero and live during the call.
        unsafe { log(environment, ERROR, c"logStatusError".as_ptr(), message.as_ptr()) };
    }
}

/// # Safety
/// `instance` must come from [`fmi3InstantiateCoSimulation`] and must not be freed.
unsafe fn component<'a>(instance: *mut c_void) -> Option<&'a mut Component> {
    // SAFETY: guaranteed by the caller; null is accepted.
    unsafe { instance.cast::<Component>().as_mut() }
}

/// # Safety
/// `text` must be null or end with a zero.
unsafe fn text<'a>(text: *const c_char) -> Option<&'a str> {
    // SAFETY: guaranteed by the caller.
    (!text.is_null()).then(|| unsafe { CStr::from_ptr(text) }.to_str().ok()).flatten()
}

/// # Safety
/// `data` must be null or point to `count` values.
unsafe fn values<'a, T>(data: *const T, count: usize) -> &'a [T] {
    // SAFETY: guaranteed by the caller.
    if data.is_null() { &[] } else { unsafe { slice::from_raw_parts(data, count) } }
}

#[unsafe(no_mangle)]
pub extern "C" fn fmi3GetVersion() -> *const c_char {
    c"3.0".as_ptr()
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3InstantiateCoSimulation(
    _name: *const c_char,
    token: *const c_char,
    resources: *const c_char,
    _visible: bool,
    _logging_on: bool,
    _event_mode_used: bool,
    _early_return_allowed: bool,
    _intermediate_variables: *const u32,
    _intermediate_count: usize,
    environment: *mut c_void,
    log: Option<LogMessage>,
    _intermediate_update: *const c_void,
) -> *mut c_void {
    // SAFETY: the standard requires texts that end with a zero, or null.
    let (token, resources) = unsafe { (text(token), text(resources)) };
    let created = match (token, resources) {
        (Some(INSTANTIATION_TOKEN), Some(folder)) => {
            Instance::from_resources(Path::new(folder)).map_err(|error| error.to_string())
        }
        (Some(INSTANTIATION_TOKEN), None) => Err("the caller gave no path of the FMU's resources".to_owned()),
        (other, _) => Err(format!("instantiation token {other:?}, expected {INSTANTIATION_TOKEN:?}")),
    };
    match created {
        Ok(instance) => Box::into_raw(Box::new(Component { instance, environment, log })).cast(),
        Err(message) => {
            // SAFETY: the caller's function accepts the caller's environment.
            unsafe { log_error(log, environment, &message) };
            ptr::null_mut()
        }
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3FreeInstance(instance: *mut c_void) {
    if !instance.is_null() {
        // SAFETY: `Box::into_raw` made the pointer, and the standard requires that it is freed
        // once.
        drop(unsafe { Box::from_raw(instance.cast::<Component>()) });
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3EnterInitializationMode(
    instance: *mut c_void,
    _tolerance_defined: bool,
    _tolerance: f64,
    start_time: f64,
    _stop_time_defined: bool,
    _stop_time: f64,
) -> c_int {
    // SAFETY: the caller passes an instance.
    let Some(component) = (unsafe { component(instance) }) else { return ERROR };
    component.instance.start(start_time);
    OK
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3Reset(instance: *mut c_void) -> c_int {
    // SAFETY: the caller passes an instance.
    let Some(component) = (unsafe { component(instance) }) else { return ERROR };
    component.instance.reset();
    OK
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetFloat64(
    instance: *mut c_void,
    references: *const u32,
    reference_count: usize,
    data: *mut f64,
    count: usize,
) -> c_int {
    // SAFETY: the caller passes an instance and arrays of the given lengths.
    let Some(component) = (unsafe { component(instance) }) else { return ERROR };
    if data.is_null() || count != reference_count {
        return if count == 0 { OK } else { ERROR };
    }
    // SAFETY: as above; `data` is not null.
    let (references, results) =
        unsafe { (values(references, reference_count), slice::from_raw_parts_mut(data, count)) };
    let read = references.iter().zip(results).try_for_each(|(reference, result)| {
        *result = component.instance.value(*reference)?;
        Ok(())
    });
    component.report(read)
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3SetFloat64(
    instance: *mut c_void,
    references: *const u32,
    reference_count: usize,
    data: *const f64,
    count: usize,
) -> c_int {
    // SAFETY: the caller passes an instance and arrays of the given lengths.
    let Some(component) = (unsafe { component(instance) }) else { return ERROR };
    if count != reference_count {
        return ERROR;
    }
    // SAFETY: as above.
    let (references, inputs) = unsafe { (values(references, reference_count), values(data, count)) };
    let set = references
        .iter()
        .zip(inputs)
        .try_for_each(|(reference, value)| component.instance.set_input(*reference, *value));
    component.report(set)
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3DoStep(
    instance: *mut c_void,
    from: f64,
    step: f64,
    _no_earlier_state: bool,
    event_handling_needed: *mut bool,
    terminate: *mut bool,
    early_return: *mut bool,
    last_time: *mut f64,
) -> c_int {
    // SAFETY: the caller passes an instance.
    let Some(component) = (unsafe { component(instance) }) else { return ERROR };
    for flag in [event_handling_needed, terminate, early_return] {
        // SAFETY: the pointer is null or points to a flag of the caller.
        if let Some(flag) = unsafe { flag.as_mut() } {
            *flag = false;
        }
    }
    let result = component.instance.step(from, step);
    let status = component.report(result);
    // SAFETY: the pointer is null or points to a number of the caller.
    if let (Some(last_time), Ok(time)) = (unsafe { last_time.as_mut() }, component.instance.value(0)) {
        *last_time = time;
    }
    status
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3GetFMUState(instance: *mut c_void, state: *mut *mut c_void) -> c_int {
    // SAFETY: the caller passes an instance and a place for a pointer to an earlier state, or null.
    let (component, Some(place)) = (unsafe { (component(instance), state.as_mut()) }) else { return ERROR };
    let Some(component) = component else { return ERROR };
    if place.is_null() {
        *place = Box::into_raw(Box::new(component.instance.clone())).cast();
    } else {
        // SAFETY: this function made the state.
        unsafe { *place.cast::<Instance>() = component.instance.clone() };
    }
    OK
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3SetFMUState(instance: *mut c_void, state: *mut c_void) -> c_int {
    // SAFETY: the caller passes an instance and a state of `fmi3GetFMUState`.
    let (Some(component), Some(state)) = (unsafe { (component(instance), state.cast::<Instance>().as_ref()) }) else {
        return ERROR;
    };
    component.instance = state.clone();
    OK
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn fmi3FreeFMUState(_instance: *mut c_void, state: *mut *mut c_void) -> c_int {
    // SAFETY: the caller passes null or a place for a pointer.
    if let Some(place) = unsafe { state.as_mut() }
        && !place.is_null()
    {
        // SAFETY: `Box::into_raw` in `fmi3GetFMUState` made the pointer.
        drop(unsafe { Box::from_raw(place.cast::<Instance>()) });
        *place = ptr::null_mut();
    }
    OK
}

/// Defines functions that only return a status. They declare no parameters: in the C convention of
/// Linux, the caller owns the arguments, so a function may ignore them.
macro_rules! status_functions {
    ($status:expr => $($name:ident)*) => {
        $(
            #[unsafe(no_mangle)]
            pub extern "C" fn $name() -> c_int {
                $status
            }
        )*
    };
}

status_functions!(OK => fmi3SetDebugLogging fmi3ExitInitializationMode fmi3Terminate fmi3EnterStepMode);

status_functions!(ERROR =>
    fmi3EnterEventMode fmi3EnterConfigurationMode fmi3ExitConfigurationMode fmi3UpdateDiscreteStates
    fmi3EvaluateDiscreteStates fmi3GetOutputDerivatives fmi3ActivateModelPartition
    fmi3GetFloat32 fmi3GetInt8 fmi3GetUInt8 fmi3GetInt16 fmi3GetUInt16 fmi3GetInt32 fmi3GetUInt32 fmi3GetInt64
    fmi3GetUInt64 fmi3GetBoolean fmi3GetString fmi3GetBinary fmi3GetClock
    fmi3SetFloat32 fmi3SetInt8 fmi3SetUInt8 fmi3SetInt16 fmi3SetUInt16 fmi3SetInt32 fmi3SetUInt32 fmi3SetInt64
    fmi3SetUInt64 fmi3SetBoolean fmi3SetString fmi3SetBinary fmi3SetClock
    fmi3GetNumberOfVariableDependencies fmi3GetVariableDependencies
    fmi3SerializedFMUStateSize fmi3SerializeFMUState fmi3DeserializeFMUState
    fmi3GetDirectionalDerivative fmi3GetAdjointDerivative
    fmi3GetIntervalDecimal fmi3GetIntervalFraction fmi3GetShiftDecimal fmi3GetShiftFraction
    fmi3SetIntervalDecimal fmi3SetIntervalFraction fmi3SetShiftDecimal fmi3SetShiftFraction
    fmi3EnterContinuousTimeMode fmi3CompletedIntegratorStep fmi3SetTime fmi3SetContinuousStates
    fmi3GetContinuousStateDerivatives fmi3GetEventIndicators fmi3GetContinuousStates
    fmi3GetNominalsOfContinuousStates fmi3GetNumberOfEventIndicators fmi3GetNumberOfContinuousStates
);

macro_rules! no_instances {
    ($($name:ident)*) => {
        $(
            #[unsafe(no_mangle)]
            pub extern "C" fn $name() -> *mut c_void {
                ptr::null_mut()
            }
        )*
    };
}

no_instances!(fmi3InstantiateModelExchange fmi3InstantiateScheduledExecution);
