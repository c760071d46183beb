//! Which training options fit together.

use super::{
    Component, MAX_CURVE_POINTS, MAX_GAUSSIANS, MAX_ITERATIONS, ModelKind, OptionError, TrainOptions, Until,
    Voxel,
};

/// Why `until=converged` is refused.
const UNTIL_REMOVED: &str = "runs no longer end early, since no trial of it saved a step; leave it out, and set iterations for a shorter run";

/// Whether a number stays positive and normal in single precision.
fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0 && (value as f32).is_normal()
}

impl TrainOptions {
    /// Checks that the options can be carried out by this version.
    ///
    /// # Errors
    /// [`OptionError`] naming the option and why.
    pub fn validated(self) -> Result<Self, OptionError> {
        if let Some(iterations) = self.iterations
            && !(1..=MAX_ITERATIONS).contains(&iterations)
        {
            return Err(OptionError::new(
                "iterations",
                format!("{iterations} is outside 1..={MAX_ITERATIONS}"),
            ));
        }
        if self.until != Until::Full {
            return Err(OptionError::new("until", UNTIL_REMOVED.to_owned()));
        }
        self.check_voxel()?;
        if let Some(lambda) = self.lambda {
            if !is_positive(lambda) {
                return Err(OptionError::new("lambda", format!("{lambda} is not a positive weight")));
            }
            if self.model != ModelKind::Tcgs {
                let error = format!("model '{}' has no rate term to weigh", self.model);
                return Err(OptionError::new("lambda", error));
            }
        }
        self.check_without()?;
        self.check_with()?;
        self.check_max_bytes()?;
        self.check_gaussians()?;
        self.check_rd_curve()?;
        self.crop.check().map_err(|error| OptionError::new("crop", error.to_string()))?;
        Ok(self)
    }

    fn check_voxel(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("voxel", text));
        match self.voxel {
            Voxel::Edge(edge) if !is_positive(edge) => error(format!("{edge} is not a positive length")),
            Voxel::Edge(_) | Voxel::Published if self.model == ModelKind::Gaussians3d => {
                error(format!("the model {} has no lattice", self.model))
            }
            _ => Ok(()),
        }
    }

    fn check_without(&self) -> Result<(), OptionError> {
        // Planes that are not compressed are true of every model.
        match self.without.iter().find(|part| **part != Component::PlaneCompression) {
            Some(part) if self.model != ModelKind::Tcgs => Err(OptionError::new(
                "without",
                format!("the model {} has no {part} to leave out", self.model),
            )),
            _ => Ok(()),
        }
    }

    fn check_with(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("plane_compression", text));
        match self.with.first() {
            None => Ok(()),
            Some(part) if self.with.len() > 1 || *part != Component::PlaneCompression => {
                error("no other part of the method is optional".to_owned())
            }
            Some(part) if !self.has(*part) || !self.has(Component::TriPlane) => {
                error(format!("the model {} has no planes to compress, or they are switched off", self.model))
            }
            Some(_) => Ok(()),
        }
    }

    fn check_max_bytes(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("max_bytes", text));
        match self.max_bytes {
            None => Ok(()),
            Some(_) if self.model != ModelKind::Tcgs => {
                error(format!("the model {} has no target size: it is written as floats", self.model))
            }
            Some(_) if !self.rd_curve.is_empty() => {
                error("is for one file, rd_curve for several; leave out one of them".to_owned())
            }
            Some(_) => Ok(()),
        }
    }

    fn check_gaussians(&self) -> Result<(), OptionError> {
        let (target, max) = (self.target_gaussians, self.max_gaussians);
        for (option, number) in [("target_gaussians", target), ("max_gaussians", max)] {
            let error = |text: String| Err(OptionError::new(option, text));
            match number {
                None => {}
                Some(number) if !(1..=MAX_GAUSSIANS).contains(&number) => {
                    return error(format!("{number} is outside 1..={MAX_GAUSSIANS}"));
                }
                Some(_) if self.model != ModelKind::Gaussians3d => {
                    return error(format!("is for the model 3dgs; {} has anchors", self.model));
                }
                Some(_) => {}
            }
        }
        match (target, max) {
            (Some(target), Some(max)) if target > max => Err(OptionError::new(
                "target_gaussians",
                format!("{target} are more than the {max} that max_gaussians allows"),
            )),
            _ => Ok(()),
        }
    }

    fn check_rd_curve(&self) -> Result<(), OptionError> {
        let error = |text: String| Err(OptionError::new("rd_curve", text));
        let curve = &self.rd_curve;
        if curve.is_empty() {
            return Ok(());
        }
        if self.model != ModelKind::Tcgs {
            return error(format!("the model {} has no rate to weigh", self.model));
        }
        if self.lambda.is_some() {
            return error("each of its points has its own lambda; leave out lambda or rd_curve".to_owned());
        }
        if curve.len() > MAX_CURVE_POINTS {
            return error(format!("{} points are more than {MAX_CURVE_POINTS}", curve.len()));
        }
        for (index, lambda) in curve.iter().enumerate() {
            if !is_positive(*lambda) {
                return error(format!("{lambda} is not a positive weight"));
            }
            if curve[..index].contains(lambda) {
                return error(format!("{lambda} is given twice"));
            }
        }
        Ok(())
    }
}
