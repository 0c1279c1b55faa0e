//! Which response time to put into equation 24, so that the plate shows the one that is asked for; and the fastest there is.
//!
//! What goes in is not what comes out: a period as long as half the response, the fast mode's ripple, a delay and the amplifier's limit are all no part of
//! equation 24, and the response is no smooth function of the design. So it is looked for: over designs evenly in the logarithm, each played on the plate.

use crate::closed_loop::AnalysisError;
use crate::tuning::design::{Demand, Design, Reading};
use crate::tuning::transient::BAND;
use platebench_plate::Tier;

/// Designs that are played, and how many times finer the neighbourhood of the fastest is looked at.
const DESIGNS: u32 = 160;
const FINER: u32 = 24;
/// The fastest design as a share of the period: what is left of the error after a period is e^(−15).
const FIRST: f64 = 0.2;
/// The slowest is at least so many of the plate's own responses, demands, and periods with their delay.
const LAST: f64 = 3.0;
const LAST_PERIODS: f64 = 30.0;
const BISECTIONS: u32 = 20;
/// A design at the very edge of its demand is met by no plate but this one: it is taken so much inside where that meets the demand too.
const INSIDE: [f64; 3] = [0.97, 0.99, 1.0];

/// A response whose overshoot fills more than this share of the band, but not more than the band, settles by a hair: on no other plate.
const BY_A_HAIR: f64 = 0.8;

/// A design with its response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The design.
    pub design: Design,
    /// 5 % settling time of |W|, s.
    pub settling: f64,
}

/// All designs of one reading.
#[derive(Debug, Clone)]
pub struct Search<'a> {
    demand: Demand<'a>,
    reading: Reading,
    /// Response times that were put in, rising, and what came out.
    played: Vec<(f64, Option<Candidate>)>,
}

impl<'a> Search<'a> {
    /// Plays them.
    pub fn new(demand: &Demand<'a>, reading: Reading) -> Self {
        let first = FIRST * demand.period();
        let own = 20.0_f64.ln() / demand.mode().sigma;
        let last = (LAST * own.max(demand.response)).max(LAST_PERIODS * (demand.period() + demand.delay));
        let mut search = Self { demand: *demand, reading, played: Vec::new() };
        let ratio = (last / first).ln() / f64::from(DESIGNS);
        let responses = (0..=DESIGNS).map(|number| first * (ratio * f64::from(number)).exp());
        search.played = responses.map(|response| (response, search.play(response))).collect();
        search
    }

    /// What comes out where `response` s are put in; `None` where that does not settle, or by a hair.
    fn play(&self, response: f64) -> Option<Candidate> {
        let design = Design::new(&self.demand, self.reading, response);
        let transient = design.step(&self.demand, self.demand.plate, self.demand.force_n);
        let by_a_hair = (BY_A_HAIR * BAND..=BAND).contains(&transient.overshoot);
        Some(Candidate { design, settling: transient.settling.filter(|_| !by_a_hair)? })
    }

    /// Whether the candidate's loops are stable with `phase_deg` of phase to spare.
    fn has_margin(&self, candidate: &Candidate, phase_deg: f64) -> Result<bool, AnalysisError> {
        let closed = candidate.design.closed(&self.demand, self.demand.plate, Tier::Modal, [true; 2])?;
        Ok(closed.spectral_radius()? < 1.0 && closed.margins().phase_deg.is_none_or(|found| found >= phase_deg))
    }

    /// The fastest response, with `phase_deg` of phase to spare.
    ///
    /// # Errors
    /// [`AnalysisError`] of any of the loops.
    pub fn fastest(&self, phase_deg: f64) -> Result<Option<Candidate>, AnalysisError> {
        let mut ranked: Vec<(usize, Candidate)> = Vec::new();
        ranked.extend(self.played.iter().enumerate().filter_map(|(number, (_, played))| Some((number, (*played)?))));
        ranked.sort_by(|(_, a), (_, b)| a.settling.total_cmp(&b.settling));
        for (number, coarse) in ranked {
            if !self.has_margin(&coarse, phase_deg)? {
                continue;
            }
            let at = |number: usize| self.played.get(number).map(|(response, _)| *response);
            let low = number.checked_sub(1).and_then(at).unwrap_or(coarse.design.response);
            let high = at(number + 1).unwrap_or(coarse.design.response);
            let between = (1..FINER).map(|part| low + (high - low) * f64::from(part) / f64::from(FINER));
            let mut finer: Vec<_> = between.filter_map(|response| self.play(response)).collect();
            finer.retain(|candidate| candidate.settling < coarse.settling);
            finer.sort_by(|a, b| a.settling.total_cmp(&b.settling));
            for candidate in finer {
                if self.has_margin(&candidate, phase_deg)? {
                    return Ok(Some(candidate));
                }
            }
            return Ok(Some(coarse));
        }
        Ok(None)
    }

    /// The design that meets the demand with `phase_deg` of phase to spare: equation 24 for the demand itself where that does, else the slowest that does, a
    /// little inside its edge.
    ///
    /// # Errors
    /// [`AnalysisError`] of any of the loops.
    pub fn meeting(&self, phase_deg: f64) -> Result<Option<Candidate>, AnalysisError> {
        let meets = |response: f64| -> Result<Option<Candidate>, AnalysisError> {
            match self.play(response).filter(|candidate| candidate.settling <= self.demand.response) {
                Some(candidate) => Ok(self.has_margin(&candidate, phase_deg)?.then_some(candidate)),
                None => Ok(None),
            }
        };
        if let Some(itself) = meets(self.demand.response)? {
            return Ok(Some(itself));
        }
        let mut slower = None;
        for (response, played) in self.played.iter().rev() {
            let in_time = played.is_some_and(|candidate| candidate.settling <= self.demand.response);
            if !in_time || meets(*response)?.is_none() {
                slower = Some(*response);
                continue;
            }
            let (mut low, mut high) = (*response, slower.unwrap_or(*response));
            for _ in 0..BISECTIONS {
                let middle = f64::midpoint(low, high);
                *(if meets(middle)?.is_some() { &mut low } else { &mut high }) = middle;
            }
            for inside in INSIDE {
                if let Some(candidate) = meets(inside * low)? {
                    return Ok(Some(candidate));
                }
            }
        }
        Ok(None)
    }
}
