//! The one probe that is meant, or why there is none.

use super::error::{ProbeError, chain};
use super::spec::ProbeSpec;
use probe_rs::probe::list::{Accessibility, Lister, ProbeListItem};
use probe_rs::probe::{DebugProbeError, DebugProbeInfo, DebugProbeSelector, Probe, ProbeCreationError, WireProtocol};
use std::io::ErrorKind;

/// Opens the probe that `spec` means. Returns its name too.
///
/// # Errors
/// [`ProbeError`] where none or several are meant, or the one cannot be opened.
pub(super) fn open(spec: &ProbeSpec, lister: &Lister) -> Result<(Probe, String), ProbeError> {
    let mut found = lister.list_with_access(spec.selector.as_ref());
    let item = match found.len() {
        0 => {
            let others = if spec.selector.is_some() { names(&lister.list_all_with_access()) } else { Vec::new() };
            return Err(ProbeError::NoProbe { wanted: spec.selector.as_ref().map(ToString::to_string), others });
        }
        1 => found.remove(0),
        _ => return Err(ProbeError::SeveralProbes { found: names(&found) }),
    };
    let name = name(&item.info);
    if item.accessibility == Accessibility::PermissionDenied {
        return Err(ProbeError::Denied { probe: name });
    }
    let opened = lister.open(DebugProbeSelector::from(&item.info));
    let mut probe = opened.map_err(|cause| refused(&name, cause))?;
    probe.select_protocol(WireProtocol::Swd).map_err(|cause| refused(&name, cause))?;
    Ok((probe, name))
}

/// As a user can write it back into the selector.
fn name(info: &DebugProbeInfo) -> String {
    let serial = info.serial_number.as_ref().map(|serial| format!(":{serial}")).unwrap_or_default();
    format!("{:04x}:{:04x}{serial} ({})", info.vendor_id, info.product_id, info.identifier)
}

fn names(items: &[ProbeListItem]) -> Vec<String> {
    items.iter().map(|item| name(&item.info)).collect()
}

fn refused(probe: &str, cause: DebugProbeError) -> ProbeError {
    let probe = probe.to_owned();
    let kind = match &cause {
        DebugProbeError::Usb(error) | DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::Usb(error)) => {
            Some(error.kind())
        }
        _ => None,
    };
    let said = chain(&cause);
    match kind {
        Some(ErrorKind::PermissionDenied) => ProbeError::Denied { probe },
        Some(ErrorKind::ResourceBusy) => ProbeError::Busy { probe, cause: said },
        // The USB library has a kind of its own for it, which arrives here as text only.
        _ if said.contains("busy") => ProbeError::Busy { probe, cause: said },
        _ => ProbeError::Open { probe, cause: Box::new(cause) },
    }
}
