//! A model as a matrix names it: a whole one, the method with a part switched off or on, or plain Gaussians of a number.

use std::{fmt, str::FromStr};

use tcgs_codec::domain::{Component, ModelKind, TrainOptions};

/// A model with its switched parts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Variant {
    /// What is trained.
    pub model: ModelKind,
    /// The part that is switched off.
    without: Option<Component>,
    /// The part that is switched on although it is off by default in short runs.
    with: Option<Component>,
    /// The number of Gaussians that more are pruned to.
    target_gaussians: Option<u32>,
    /// The number of Gaussians that growth ends at.
    max_gaussians: Option<u32>,
}

/// After the number of Gaussians that growth ends at.
const CAPPED: &str = "-capped";

impl Variant {
    /// The options of its runs, from those that all models share.
    pub fn options(&self, shared: &TrainOptions) -> TrainOptions {
        TrainOptions {
            model: self.model,
            without: self.without.into_iter().collect(),
            with: self.with.into_iter().collect(),
            target_gaussians: self.target_gaussians,
            max_gaussians: self.max_gaussians,
            ..shared.clone()
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.model.name())?;
        if let Some(part) = self.without {
            write!(f, "-{part}")?;
        }
        if let Some(part) = self.with {
            write!(f, "+{part}")?;
        }
        if let Some(number) = self.target_gaussians {
            write!(f, ":{number}")?;
        }
        if let Some(number) = self.max_gaussians {
            write!(f, ":{number}{CAPPED}")?;
        }
        Ok(())
    }
}

impl FromStr for Variant {
    type Err = String;

    /// `3dgs`, `scaffold` or `tcgs`, the last with `-PART` or `+PART` after it, in this order; `3dgs:NUMBER` is pruned to a number of
    /// Gaussians, `3dgs:NUMBER-capped` grows to it.
    fn from_str(text: &str) -> Result<Self, String> {
        if text.contains('@') {
            return Err(format!("'{text}': weights have a list of their own, lambda"));
        }
        let number = |text: &str| {
            text.parse::<u32>().map(Some).map_err(|_| format!("'{text}' is not a number of Gaussians"))
        };
        let (text, target_gaussians, max_gaussians) = match text.split_once(':') {
            None => (text, None, None),
            Some((model, count)) => match count.strip_suffix(CAPPED) {
                None => (model, number(count)?, None),
                Some(count) => (model, None, number(count)?),
            },
        };
        let part = |text: &str| text.parse::<Component>();
        let (name, with) = match text.split_once('+') {
            None => (text, None),
            Some((name, text)) => (name, Some(part(text)?)),
        };
        let (model, without) = match name.split_once('-') {
            None => (name, None),
            Some((model, text)) => (model, Some(part(text)?)),
        };
        let model: ModelKind = model.parse()?;
        if (without.is_some() || with.is_some()) && model != ModelKind::Tcgs {
            return Err(format!("'{text}': only tcgs has parts to leave out or to ask for"));
        }
        let variant = Self { model, without, with, target_gaussians, max_gaussians };
        variant.options(&TrainOptions::default()).validated().map_err(|error| error.error)?;
        Ok(variant)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_are_read_as_they_are_written() {
        let whole = ["3dgs", "scaffold", "tcgs", "3dgs:16000", "3dgs:16000-capped"];
        let parts = ["tcgs-wavelet", "tcgs+plane-compression", "tcgs-masks+plane-compression"];
        for text in whole.into_iter().chain(parts) {
            assert_eq!(text.parse::<Variant>().expect(text).to_string(), text);
        }
        let refused = [
            "",
            "nerf",
            "tcgs-",
            "tcgs-hope",
            "3dgs-wavelet",
            "tcgs+masks",
            "tcgs-plane-compression+plane-compression",
            "scaffold+plane-compression",
            "scaffold-wavelet",
            "tcgs@0.1",
            "tcgs:1000",
            "3dgs:",
            "3dgs:0",
            "3dgs:many",
            "3dgs:1000-pruned",
        ];
        for text in refused {
            assert!(text.parse::<Variant>().is_err(), "{text}");
        }
    }
}
