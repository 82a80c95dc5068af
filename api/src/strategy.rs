//! How rays and scene data meet.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which data a task holds and which rays it gets. The image is the same bytes for all of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
pub enum Strategy {
    /// Rays dealt evenly to tasks; a task loads any split it needs, through a cache.
    DemandDriven,
    /// The chosen split and every split that shares a cell with it; nearest hits are decided by an extra reduce step.
    SchedulingGrid,
    /// One split a task, after overlap reduction gave each cell one owner.
    SchedulingGridOverlapReduced,
    /// As many splits as the worker's memory holds, kept warm; only rays that leave them travel.
    #[default]
    Auto,
}

/// Why a text names no strategy.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no strategy: choose demand-driven, scheduling-grid, scheduling-grid-overlap-reduced or auto")]
pub struct StrategyError(String);

impl Strategy {
    /// All of them, from the least to the most local.
    pub const ALL: [Strategy; 4] =
        [Strategy::DemandDriven, Strategy::SchedulingGrid, Strategy::SchedulingGridOverlapReduced, Strategy::Auto];

    /// Its name on the command line and in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Strategy::DemandDriven => "demand-driven",
            Strategy::SchedulingGrid => "scheduling-grid",
            Strategy::SchedulingGridOverlapReduced => "scheduling-grid-overlap-reduced",
            Strategy::Auto => "auto",
        }
    }
}

impl fmt::Display for Strategy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Strategy {
    type Err = StrategyError;
    fn from_str(text: &str) -> Result<Self, StrategyError> {
        let strategy = Strategy::ALL.into_iter().find(|s| s.name() == text);
        strategy.ok_or_else(|| StrategyError(text.chars().take(60).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back() {
        for s in Strategy::ALL {
            assert_eq!(s.name().parse(), Ok(s));
        }
        assert!("Auto".parse::<Strategy>().unwrap_err().to_string().contains("demand-driven"));
    }
}
