//! Turns a panic of the emulator into an error.

use crate::target_error::TargetError;
use std::any::Any;
use std::panic::{self, AssertUnwindSafe};

pub(super) fn catch_emulator_panic<T>(run: impl FnOnce() -> Result<T, TargetError>) -> Result<T, TargetError> {
    let panicked = |cause: Box<dyn Any + Send>| {
        let text = cause.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("no message");
        TargetError::Emulator(format!("it panicked: {text}"))
    };
    panic::catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|cause| Err(panicked(cause)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_a_panic_of_the_emulator_as_an_error() {
        let result =
            catch_emulator_panic(
                || if std::hint::black_box(false) { Ok(()) } else { panic!("checked at construction") },
            );
        assert_eq!(result, Err(TargetError::Emulator("it panicked: checked at construction".to_owned())));
    }
}
