//! Query parameters, taken one by one by name; parameters left over are refused.

use std::str::FromStr;

use axum::{extract::FromRequestParts, http::request::Parts};

use crate::http::problem::{ApiResult, ProblemResponse};

/// The query parameters that have not been taken yet; an extractor.
#[derive(Debug)]
pub(crate) struct Parameters(Vec<(String, String)>);

impl<S: Sync> FromRequestParts<S> for Parameters {
    type Rejection = ProblemResponse;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> ApiResult<Self> {
        Self::parse(parts.uri.query())
    }
}

impl Parameters {
    /// Reads a query string; a name may occur once.
    pub(crate) fn parse(query: Option<&str>) -> ApiResult<Self> {
        Self(Vec::new()).with(
            serde_urlencoded::from_str(query.unwrap_or_default())
                .map_err(|error| ProblemResponse::parameter("query", error))?,
        )
    }

    /// The parameters and those of a form.
    pub(crate) fn with(mut self, more: Vec<(String, String)>) -> ApiResult<Self> {
        self.0.extend(more);
        let pairs = self.0;
        for (index, (name, _)) in pairs.iter().enumerate() {
            if pairs[..index].iter().any(|(earlier, _)| earlier == name) {
                return Err(ProblemResponse::parameter(name, "is given twice"));
            }
        }
        Ok(Self(pairs))
    }

    /// The text of a parameter.
    pub(crate) fn take(&mut self, name: &str) -> Option<String> {
        let index = self.0.iter().position(|(given, _)| given == name)?;
        Some(self.0.swap_remove(index).1)
    }

    /// The values of all parameters `name[KEY]`, by key.
    pub(crate) fn take_map(&mut self, name: &str) -> Vec<(String, String)> {
        let key =
            |given: &str| Some(given.strip_prefix(name)?.strip_prefix('[')?.strip_suffix(']')?.to_owned());
        let (taken, left): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.0).into_iter().partition(|(given, _)| key(given).is_some());
        self.0 = left;
        taken.into_iter().filter_map(|(given, value)| Some((key(&given)?, value))).collect()
    }

    /// The value of a parameter; `expected` completes "is not ...".
    pub(crate) fn take_as<T: FromStr>(&mut self, name: &str, expected: &str) -> ApiResult<Option<T>> {
        let Some(text) = self.take(name) else { return Ok(None) };
        let error = |_| ProblemResponse::parameter(name, format!("'{text}' is not {expected}"));
        text.trim().parse().map(Some).map_err(error)
    }

    /// A whole number from 1 to `max`, or `default`.
    pub(crate) fn take_count(&mut self, name: &str, default: u32, max: u32) -> ApiResult<u32> {
        let count = self.take_as(name, "a whole number")?.unwrap_or(default);
        if !(1..=max).contains(&count) {
            return Err(ProblemResponse::parameter(name, format!("{count} is outside 1..={max}")));
        }
        Ok(count)
    }

    /// `N` finite numbers separated by commas.
    pub(crate) fn take_numbers<const N: usize>(
        &mut self,
        name: &str,
        expected: &str,
    ) -> ApiResult<Option<[f64; N]>> {
        let Some(text) = self.take(name) else { return Ok(None) };
        let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
        let numbers = numbers.and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
        let numbers = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
        numbers
            .map(Some)
            .ok_or_else(|| ProblemResponse::parameter(name, format!("'{text}' is not {expected}")))
    }

    /// What is left, for parameters whose names are decided elsewhere.
    pub(crate) fn rest(self) -> Vec<(String, String)> {
        self.0
    }

    /// Refuses parameters left over.
    pub(crate) fn finish(self) -> ApiResult<()> {
        match self.0.first() {
            None => Ok(()),
            Some((name, _)) => Err(ProblemResponse::parameter(name, "is not a parameter here")),
        }
    }
}
