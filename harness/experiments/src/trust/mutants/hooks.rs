//! Builds mutants that change one kind of message.

use crate::trust::mutant_controller::Mutant;
use platebench_wire::{Command, Configure, Packet, Sample};

struct OnConfigure<F>(F);

impl<F: FnMut(&mut Configure) + Send> Mutant for OnConfigure<F> {
    fn on_configure(&mut self, configure: &mut Configure) {
        (self.0)(configure);
    }
}

struct OnSample<F>(F);

impl<F: FnMut(&mut Sample) + Send> Mutant for OnSample<F> {
    fn on_sample(&mut self, sample: &mut Sample) {
        (self.0)(sample);
    }
}

struct OnCommand<F>(F);

impl<F: FnMut(&mut Command) + Send> Mutant for OnCommand<F> {
    fn on_command(&mut self, command: &mut Command) {
        (self.0)(command);
    }
}

struct OnSend<F>(F);

impl<F: FnMut(&mut Packet) + Send> Mutant for OnSend<F> {
    fn on_send(&mut self, packet: &mut Packet) {
        (self.0)(packet);
    }
}

pub(crate) fn on_configure(change: impl FnMut(&mut Configure) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(OnConfigure(change))
}

pub(crate) fn on_sample(change: impl FnMut(&mut Sample) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(OnSample(change))
}

/// Changes only commands that the controller sends in state `Running`.
pub(crate) fn on_command(change: impl FnMut(&mut Command) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(OnCommand(change))
}

pub(crate) fn on_send(change: impl FnMut(&mut Packet) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(OnSend(change))
}
