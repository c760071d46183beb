//! What competes: a model, or the method without one of its parts.

use std::{collections::BTreeSet, fmt, str::FromStr};

use tcgs::domain::{Component, ModelKind, TrainOptions};

/// One row of the table for each set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Entry {
    /// What is trained.
    pub(crate) model: ModelKind,
    /// The part that is left out.
    pub(crate) without: Option<Component>,
}

impl Entry {
    /// The baselines, the method, and the method without each part that this version can leave out.
    pub(crate) fn defaults() -> Vec<Self> {
        let whole = |model| Self { model, without: None };
        let ablations = [Component::Masks, Component::Wavelet]
            .map(|part| Self { model: ModelKind::Tcgs, without: Some(part) });
        let models = [ModelKind::Gaussians3d, ModelKind::Scaffold, ModelKind::Tcgs].map(whole);
        let possible = |entry: &Self| entry.options(&TrainOptions::default()).validated().is_ok();
        models.into_iter().chain(ablations).filter(possible).collect()
    }

    /// Whether it competes for the same seconds too; ablations are compared step by step.
    pub(crate) fn is_whole(&self) -> bool {
        self.without.is_none()
    }

    /// The options of its runs, from those that all runs share.
    pub(crate) fn options(&self, shared: &TrainOptions) -> TrainOptions {
        TrainOptions {
            model: self.model,
            without: self.without.into_iter().collect::<BTreeSet<_>>(),
            ..shared.clone()
        }
    }
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.without {
            None => f.pad(self.model.name()),
            Some(part) => f.pad(&format!("{}-{part}", self.model)),
        }
    }
}

impl FromStr for Entry {
    type Err = String;

    /// `3dgs`, `scaffold`, `tcgs`, or `tcgs-PART`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (model, without) = match text.split_once('-') {
            None => (text, None),
            Some((model, part)) => (model, Some(part.parse::<Component>().map_err(|fault| fault.fault)?)),
        };
        let model: ModelKind = model.parse().map_err(|fault: tcgs::domain::OptionError| fault.fault)?;
        if without.is_some() && model != ModelKind::Tcgs {
            return Err(format!("'{text}': only tcgs has parts to leave out"));
        }
        let entry = Self { model, without };
        entry.options(&TrainOptions::default()).validated().map_err(|fault| fault.fault)?;
        Ok(entry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_read_as_they_are_written() {
        for text in ["3dgs", "scaffold", "tcgs", "tcgs-wavelet"] {
            assert_eq!(text.parse::<Entry>().expect(text).to_string(), text);
        }
        for text in ["", "nerf", "tcgs-", "tcgs-hope", "3dgs-wavelet", "scaffold-wavelet"] {
            assert!(text.parse::<Entry>().is_err(), "{text}");
        }
        let names: Vec<String> = Entry::defaults().iter().map(Entry::to_string).collect();
        assert!(
            names.starts_with(&["3dgs".to_owned(), "scaffold".to_owned(), "tcgs".to_owned()]),
            "{names:?}"
        );
    }
}
