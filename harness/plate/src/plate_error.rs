//! Checks numbers of a plate file and defines the error of an invalid one.

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` is {value}, expected {expected}")]
pub struct PlateError {
    pub key: &'static str,
    pub value: String,
    pub expected: &'static str,
}

pub(crate) fn check(
    holds: bool,
    key: &'static str,
    value: &impl ToString,
    expected: &'static str,
) -> Result<(), PlateError> {
    if holds { Ok(()) } else { Err(PlateError { key, value: value.to_string(), expected }) }
}

pub(crate) fn positive(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite() && value > 0.0, key, &value, "a finite number above 0").map(|()| value)
}

pub(crate) fn finite(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite(), key, &value, "a finite number").map(|()| value)
}
