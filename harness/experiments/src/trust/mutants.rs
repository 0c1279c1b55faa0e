//! Implements the mutants.

pub(crate) mod clean;
pub(crate) mod excitation;
pub(crate) mod hooks;
pub(crate) mod line;
pub(crate) mod loops;
pub(crate) mod plate_changes;
pub(crate) mod protocol;
pub(crate) mod timing;
pub(crate) mod values;
