//! Records what happened to the controllers of a shard, in the metadata of its part.

/// Key of the metadata. A part without this key ended well.
pub(crate) const KEY: &str = "controller";

#[expect(clippy::struct_excessive_bools, reason = "independent events of one shard")]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ShardEnd {
    /// A controller did not confirm 0 V at the end, or did not stay there.
    pub unconfirmed: bool,
    /// A controller commanded a drive after it had confirmed 0 V, outside all trials.
    pub driven: bool,
    /// A controller was lost in a trial, and the rig caused it.
    pub lost: bool,
    /// A trial failed. Not stored, because the rows of the part show it.
    pub failed: bool,
}

impl ShardEnd {
    pub fn add(&mut self, other: Self) {
        self.failed |= other.failed;
        self.unconfirmed |= other.unconfirmed;
        self.driven |= other.driven;
        self.lost |= other.lost;
    }

    /// True if the rig counts as lost, by the rule of `platebench run`: a failure of the controller
    /// also explains a missing confirmation of 0 V.
    pub fn is_lost(self, has_failure: bool) -> bool {
        self.lost || (self.unconfirmed && !self.driven && !has_failure)
    }

    /// `None` if all controllers ended well.
    pub(crate) fn encode(self) -> Option<String> {
        let names = [(self.unconfirmed, "unconfirmed"), (self.driven, "driven"), (self.lost, "lost")];
        let names: Vec<_> = names.into_iter().filter(|(is_set, _)| *is_set).map(|(_, name)| name).collect();
        (!names.is_empty()).then(|| names.join(" "))
    }

    pub(crate) fn decode(text: &str) -> Self {
        let has = |wanted| text.split(' ').any(|name| name == wanted);
        Self { unconfirmed: has("unconfirmed"), driven: has("driven"), lost: has("lost"), failed: false }
    }
}
