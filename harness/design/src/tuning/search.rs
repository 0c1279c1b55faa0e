//! Searches the response time of equation 24 with which the plate meets the target. Equation 24
//! ignores the length of the period, the ripple of the fast mode, the delay and the drive limit.
//! The response is not smooth in the design. Therefore designs with logarithmically spaced response
//! times are simulated.

use crate::loops::closed_loop::AnalysisError;
use crate::loops::controller::Discretisation;
use crate::tuning::design::{GainDesign, TuningTarget};
use crate::tuning::transient::BAND;
use platebench_plate::Tier;
use platebench_verdict::bisection::try_bisect;

const DESIGNS: u32 = 160;
const REFINEMENT: u32 = 24;
/// Response time of the fastest design, in periods. After one period its error is e^(−15).
const FASTEST_RESPONSE_PERIODS: f64 = 0.2;
/// Slowest response time of a design, relative to the longer one of plate and target. It is at
/// least [`SLOWEST_RESPONSE_PERIODS`] times (period + delay).
const SLOWEST_RESPONSE_FACTOR: f64 = 3.0;
const SLOWEST_RESPONSE_PERIODS: f64 = 30.0;
const BISECTIONS: u32 = 20;
/// Safety factors of the response time: a marginal design misses the target on other plates.
const SAFETY_FACTORS: [f64; 3] = [0.97, 0.99, 1.0];

/// A design with an overshoot between this share of the band and the whole band is rejected,
/// because it leaves the band on other plates.
const MAX_OVERSHOOT_BAND_SHARE: f64 = 0.8;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DesignCandidate {
    pub design: GainDesign,
    pub settling: f64,
}

#[derive(Debug, Clone)]
pub struct DesignSearch<'a> {
    target: TuningTarget<'a>,
    discretisation: Discretisation,
    candidates: Vec<(f64, Option<DesignCandidate>)>,
}

impl<'a> DesignSearch<'a> {
    pub fn new(target: &TuningTarget<'a>, discretisation: Discretisation) -> Self {
        let first = FASTEST_RESPONSE_PERIODS * target.period();
        let own = 20.0_f64.ln() / target.mode().sigma;
        let last = (SLOWEST_RESPONSE_FACTOR * own.max(target.response))
            .max(SLOWEST_RESPONSE_PERIODS * (target.period() + target.delay));
        let mut search = Self { target: *target, discretisation, candidates: Vec::new() };
        let ratio = (last / first).ln() / f64::from(DESIGNS);
        let responses = (0..=DESIGNS).map(|number| first * (ratio * f64::from(number)).exp());
        search.candidates = responses.map(|response| (response, search.evaluate(response))).collect();
        search
    }

    /// `None` if the design does not settle or its overshoot almost fills the band.
    fn evaluate(&self, response: f64) -> Option<DesignCandidate> {
        let design = GainDesign::new(&self.target, self.discretisation, response);
        let transient = design.simulate_step(&self.target, self.target.plate);
        let by_a_hair = (MAX_OVERSHOOT_BAND_SHARE * BAND..=BAND).contains(&transient.overshoot);
        Some(DesignCandidate { design, settling: transient.settling.filter(|_| !by_a_hair)? })
    }

    fn has_margin(&self, candidate: &DesignCandidate, phase_deg: f64) -> Result<bool, AnalysisError> {
        let closed = candidate.design.closed_loop(&self.target, self.target.plate, Tier::Modal, [true; 2])?;
        Ok(closed.spectral_radius()? < 1.0 && closed.margins().phase_deg.is_none_or(|found| found >= phase_deg))
    }

    pub fn fastest(&self, phase_deg: f64) -> Result<Option<DesignCandidate>, AnalysisError> {
        let settled = self.candidates.iter().enumerate();
        let mut ranked: Vec<(usize, DesignCandidate)> =
            settled.filter_map(|(number, (_, played))| Some((number, (*played)?))).collect();
        ranked.sort_by(|(_, a), (_, b)| a.settling.total_cmp(&b.settling));
        for (number, coarse) in ranked {
            if !self.has_margin(&coarse, phase_deg)? {
                continue;
            }
            let at = |number: usize| self.candidates.get(number).map(|(response, _)| *response);
            let low = number.checked_sub(1).and_then(at).unwrap_or(coarse.design.response);
            let high = at(number + 1).unwrap_or(coarse.design.response);
            let between = (1..REFINEMENT).map(|part| low + (high - low) * f64::from(part) / f64::from(REFINEMENT));
            let mut finer: Vec<_> = between.filter_map(|response| self.evaluate(response)).collect();
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

    /// The design for the target's response time, if it meets the target. Otherwise the slowest
    /// design that does, with a safety factor.
    pub fn meeting_target(&self, phase_deg: f64) -> Result<Option<DesignCandidate>, AnalysisError> {
        let meets = |response: f64| -> Result<Option<DesignCandidate>, AnalysisError> {
            match self.evaluate(response).filter(|candidate| candidate.settling <= self.target.response) {
                Some(candidate) => Ok(self.has_margin(&candidate, phase_deg)?.then_some(candidate)),
                None => Ok(None),
            }
        };
        if let Some(itself) = meets(self.target.response)? {
            return Ok(Some(itself));
        }
        let mut slower = None;
        for (response, played) in self.candidates.iter().rev() {
            let in_time = played.is_some_and(|candidate| candidate.settling <= self.target.response);
            if !in_time || meets(*response)?.is_none() {
                slower = Some(*response);
                continue;
            }
            let is_met = |response| meets(response).map(|candidate| candidate.is_some());
            let [low, _] = try_bisect([*response, slower.unwrap_or(*response)], BISECTIONS, is_met)?;
            for inside in SAFETY_FACTORS {
                if let Some(candidate) = meets(inside * low)? {
                    return Ok(Some(candidate));
                }
            }
        }
        Ok(None)
    }
}
