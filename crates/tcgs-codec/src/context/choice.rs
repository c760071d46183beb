//! Settings and result of the search for contexts.

use serde::{Deserialize, Serialize};

use crate::domain::{Component, TrainOptions, context_model::ContextKind};

/// How the symbols of an attribute group are predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GroupChoice {
    /// One distribution a channel, the same for every anchor.
    Static,
    /// By a network that is given something about the anchor.
    Network {
        /// Its inputs.
        kind: ContextKind,
        /// Bits of a weight: 8, 6 or 4.
        weight_bits: u8,
    },
}

/// The contexts of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContextChoice {
    /// Index of the planes among the candidates, `None` if no group samples them.
    pub planes: Option<usize>,
    /// Choices in the order of [`crate::domain::AttributeGroup::ALL`].
    pub groups: [GroupChoice; 3],
}

impl ContextChoice {
    /// Tables for every group.
    pub const STATIC: Self = Self { planes: None, groups: [GroupChoice::Static; 3] };
}

/// How an encoder decides between contexts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ContextSearch {
    /// Whatever takes the fewest bytes in the file, of all candidates.
    #[default]
    Cheapest,
    /// Exactly this choice.
    Fixed(ContextChoice),
}

/// Whether an encoder lets the channels of a group follow from each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RegressionSearch {
    /// In the groups where that saves bytes.
    #[default]
    WhereItPays,
    /// In no group.
    Never,
}

impl RegressionSearch {
    /// As the options of a run ask.
    #[must_use]
    pub fn of(options: &TrainOptions) -> Self {
        if options.has(Component::Regression) { Self::WhereItPays } else { Self::Never }
    }
}

/// How an encoder chooses contexts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ContextSettings {
    /// Which contexts to use.
    pub search: ContextSearch,
    /// Whether to use regressions within an anchor.
    pub regression: RegressionSearch,
    /// By how many steps of the step table (7/32 of an octave each) the features, scalings and offsets are quantized more
    /// coarsely than trained; negative is finer. This and not a larger base step is how to save bytes where there are
    /// networks: their predictions are in base steps.
    pub coarser: [i8; 3],
}
