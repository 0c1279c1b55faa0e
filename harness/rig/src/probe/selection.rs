//! Finds and opens the requested debug probe.

use super::error::{ProbeError, error_chain};
use super::spec::ProbeSpec;
use probe_rs::probe::list::{Accessibility, Lister, ProbeListItem};
use probe_rs::probe::{DebugProbeError, DebugProbeInfo, DebugProbeSelector, Probe, ProbeCreationError, WireProtocol};
use std::io::ErrorKind;

pub(super) fn open_probe(spec: &ProbeSpec, lister: &Lister) -> Result<(Probe, String), ProbeError> {
    let mut found = lister.list_with_access(spec.selector.as_ref());
    let item = match found.len() {
        0 => {
            let others =
                if spec.selector.is_some() { selectors_of(&lister.list_all_with_access()) } else { Vec::new() };
            return Err(ProbeError::NoProbe { wanted: spec.selector.as_ref().map(ToString::to_string), others });
        }
        1 => found.remove(0),
        _ => return Err(ProbeError::SeveralProbes { found: selectors_of(&found) }),
    };
    let name = selector_of(&item.info);
    if item.accessibility == Accessibility::PermissionDenied {
        return Err(ProbeError::PermissionDenied { probe: name });
    }
    let opened = lister.open(DebugProbeSelector::from(&item.info));
    let mut probe = opened.map_err(|cause| open_error(&name, cause))?;
    probe.select_protocol(WireProtocol::Swd).map_err(|cause| open_error(&name, cause))?;
    Ok((probe, name))
}

fn selector_of(info: &DebugProbeInfo) -> String {
    let serial = info.serial_number.as_ref().map(|serial| format!(":{serial}")).unwrap_or_default();
    format!("{:04x}:{:04x}{serial} ({})", info.vendor_id, info.product_id, info.identifier)
}

fn selectors_of(items: &[ProbeListItem]) -> Vec<String> {
    items.iter().map(|item| selector_of(&item.info)).collect()
}

fn open_error(probe: &str, cause: DebugProbeError) -> ProbeError {
    let probe = probe.to_owned();
    let kind = match &cause {
        DebugProbeError::Usb(error) | DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::Usb(error)) => {
            Some(error.kind())
        }
        _ => None,
    };
    let text = error_chain(&cause);
    match kind {
        Some(ErrorKind::PermissionDenied) => ProbeError::PermissionDenied { probe },
        Some(ErrorKind::ResourceBusy) => ProbeError::Busy { probe, cause: text },
        // The USB library reports a busy probe only in the text of its error.
        _ if text.contains("busy") => ProbeError::Busy { probe, cause: text },
        _ => ProbeError::Open { probe, cause: Box::new(cause) },
    }
}
