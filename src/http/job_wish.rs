//! What a job is to be, as a query string or a JSON object says it: the same names and meanings in both.

use axum::http::StatusCode;
use jiff::{SignedDuration, Timestamp};
use serde_json::{Map, Value};

use super::{problem::Fault, query::Parameters};
use crate::domain::{MAX_PRIORITY, OptionError, SceneId, TrainOptions};

/// Longest time that a job may be given, in seconds.
const MAX_DEADLINE: u32 = 366 * 24 * 3600;
/// Largest integer that JSON readers with 64-bit floats alone, JavaScript's among them, read and write exactly.
const MAX_SEED: u64 = (1 << 53) - 1;
/// Characters of an unknown name that are said again.
const LONGEST_NAME: usize = 100;

/// What is asked for besides the dataset.
#[derive(Debug, Default)]
pub(super) struct JobWish {
    pub(super) options: TrainOptions,
    pub(super) priority: i32,
    pub(super) deadline_s: Option<u32>,
}

impl JobWish {
    /// Reads a query string.
    pub(super) fn from_query(mut parameters: Parameters) -> Result<Self, Fault> {
        let priority = parameters.take_as("priority", "a whole number")?.unwrap_or(0);
        let deadline_s = parameters.take_as("deadline_s", "a whole number of seconds")?;
        let mut options = TrainOptions::default();
        for (name, text) in parameters.rest() {
            expect_known(&name)?;
            options.set(&name, &text).map_err(|error| invalid_option(&error))?;
        }
        Self { options, priority, deadline_s }.validated()
    }

    /// Reads a JSON object, which also names the scene.
    pub(super) fn from_json(content: &[u8]) -> Result<(SceneId, Self), Fault> {
        let mut object: Map<String, Value> =
            serde_json::from_slice(content).map_err(|error| bad_json(&error))?;
        let scene = object
            .remove("scene_id")
            .ok_or_else(|| Fault::parameter("scene_id", "is missing; name the scene to train on"))?;
        let scene = field("scene_id", scene, "a scene's id")?;
        let priority = object.remove("priority").map(|value| field("priority", value, "a whole number"));
        let deadline_s = object
            .remove("deadline_s")
            .filter(|value| !value.is_null())
            .map(|value| field("deadline_s", value, "a whole number of seconds"));
        let (priority, deadline_s) = (priority.transpose()?.unwrap_or(0), deadline_s.transpose()?);
        let options = options(object)?;
        Ok((scene, Self { options, priority, deadline_s }.validated()?))
    }

    fn validated(self) -> Result<Self, Fault> {
        if !(-MAX_PRIORITY..=MAX_PRIORITY).contains(&self.priority) {
            let fault = format!("{} is outside -{MAX_PRIORITY}..={MAX_PRIORITY}", self.priority);
            return Err(Fault::parameter("priority", fault));
        }
        if let Some(seconds) = self.deadline_s {
            check_deadline(seconds)?;
        }
        let seed = self.options.seed;
        if seed > MAX_SEED {
            let fault = OptionError::new("seed", format!("{seed} is outside 0..={MAX_SEED}"));
            return Err(invalid_option(&fault));
        }
        Ok(Self { options: self.options.validated().map_err(|error| invalid_option(&error))?, ..self })
    }
}

fn field<T: serde::de::DeserializeOwned>(name: &str, value: Value, expected: &str) -> Result<T, Fault> {
    serde_json::from_value(value.clone())
        .map_err(|_| Fault::parameter(name, format!("{value} is not {expected}")))
}

/// Training options in an object's fields. Lists may also be what the query string has.
fn options(fields: Map<String, Value>) -> Result<TrainOptions, Fault> {
    let mut lists = TrainOptions::default();
    let mut whole = Map::new();
    for (name, value) in fields {
        expect_known(&name)?;
        match (name.as_str(), &value) {
            ("without" | "with" | "rd_curve", Value::String(text)) => {
                lists.set(&name, text).map_err(|error| invalid_option(&error))?;
                let parsed = serde_json::to_value(&lists).map_err(|error| Fault::internal(&error))?;
                // Not there if there is nothing in it.
                whole.extend(parsed.get(&name).map(|list| (name.clone(), list.clone())));
            }
            _ => {
                // One at a time, so that the fault names its field.
                let alone = Value::Object(Map::from_iter([(name.clone(), value.clone())]));
                serde_json::from_value::<TrainOptions>(alone)
                    .map_err(|error| invalid_field(&name, &error))?;
                whole.insert(name, value);
            }
        }
    }
    serde_json::from_value(Value::Object(whole)).map_err(|error| invalid_field("options", &error))
}

/// 422 for a name that says nothing about a job.
fn expect_known(name: &str) -> Result<(), Fault> {
    if TrainOptions::NAMES.contains(&name) {
        return Ok(());
    }
    let shown: String = name.chars().take(LONGEST_NAME).collect();
    let detail = format!(
        "{shown}: is not an option; there are priority, deadline_s, {}",
        TrainOptions::NAMES.join(", ")
    );
    Err(Fault::new(StatusCode::UNPROCESSABLE_ENTITY, "invalid-option", "Invalid training option", detail))
}

fn invalid_field(name: &str, error: &serde_json::Error) -> Fault {
    Fault::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "invalid-option",
        "Invalid training option",
        format!("{name}: {error}"),
    )
}

fn invalid_option(error: &OptionError) -> Fault {
    Fault::new(
        StatusCode::UNPROCESSABLE_ENTITY,
        "invalid-option",
        "Invalid training option",
        error.to_string(),
    )
}

/// 400 for what is not JSON, 422 for JSON of another shape.
pub(super) fn bad_json(error: &serde_json::Error) -> Fault {
    if error.is_data() {
        return Fault::parameter("body", error);
    }
    let detail = format!("the body is not JSON: {error}");
    Fault::new(StatusCode::BAD_REQUEST, "malformed-json", "Malformed JSON", detail)
}

/// 422 for a deadline that is none.
pub(super) fn check_deadline(seconds: u32) -> Result<(), Fault> {
    if (1..=MAX_DEADLINE).contains(&seconds) {
        return Ok(());
    }
    Err(Fault::parameter("deadline_s", format!("{seconds} is outside 1..={MAX_DEADLINE}")))
}

/// When a job that may take so long from now is given up.
pub(super) fn deadline(now: Timestamp, seconds: Option<u32>) -> Option<Timestamp> {
    now.checked_add(SignedDuration::from_secs(seconds?.into())).ok()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const SCENE: &str = "019364d3-0000-7000-8000-000000000001";

    fn read(mut fields: Value) -> Result<JobWish, String> {
        fields["scene_id"] = json!(SCENE);
        let read = JobWish::from_json(&serde_json::to_vec(&fields).expect("JSON"));
        read.map(|(_, wish)| wish).map_err(|fault| format!("{fault:?}"))
    }

    #[test]
    fn an_object_means_what_the_query_string_means() {
        let query = "preset=standard&iterations=7&seed=3&background=white&without=masks,wavelet&voxel=0.5&\
                     with=plane-compression&\
                     rd_curve=0.004,1e-3&priority=-5&deadline_s=60";
        let query = JobWish::from_query(Parameters::parse(Some(query)).expect("a query")).expect("possible");
        for (without, with, rd_curve) in [
            (json!(["masks", "wavelet"]), json!(["plane-compression"]), json!([0.004, 0.001])),
            (json!("masks,wavelet"), json!("plane-compression"), json!("0.004,1e-3")),
        ] {
            let object = read(json!({
                "preset": "standard", "iterations": 7, "seed": 3, "background": "white", "without": without,
                "with": with, "voxel": 0.5, "rd_curve": rd_curve, "priority": -5, "deadline_s": 60, "lambda": null,
            }))
            .expect("possible");
            assert_eq!(object.options, query.options);
            assert_eq!((object.priority, object.deadline_s), (query.priority, query.deadline_s));
        }
    }

    #[test]
    fn who_mistypes_a_name_is_told_which_there_are() {
        let query = Parameters::parse(Some("iteratons=7")).expect("a query");
        let query = JobWish::from_query(query).expect_err("no such option");
        for fault in [format!("{query:?}"), read(json!({ "iteratons": 7 })).expect_err("no such option")] {
            for named in ["iteratons: is not", "deadline_s, preset, iterations,", "rd_curve"] {
                assert!(fault.contains(named), "{fault}");
            }
        }
        let long = read(json!({ "x".repeat(5000): 1 })).expect_err("no such option");
        assert!(long.len() < 1000);
    }

    #[test]
    fn seeds_are_taken_as_far_as_every_language_s_json_is_exact() {
        let largest = read(json!({ "seed": MAX_SEED })).expect("a job");
        assert_eq!(
            (largest.options.seed, MAX_SEED),
            (9_007_199_254_740_991, (1_u64 << f64::MANTISSA_DIGITS) - 1)
        );
        let query = Parameters::parse(Some("seed=18446744073709551615")).expect("a query");
        let fault = format!("{:?}", JobWish::from_query(query).expect_err("too large"));
        assert!(fault.contains("seed: 18446744073709551615 is outside 0..=9007199254740991"), "{fault}");
    }

    #[test]
    fn faults_name_their_field() {
        for (fields, named) in [
            (json!({ "colour": "red" }), "colour"),
            (json!({ "iterations": "7" }), "iterations"),
            (json!({ "iterations": 0 }), "iterations"),
            (json!({ "seed": -1 }), "seed"),
            (json!({ "seed": (1_u64 << 53) }), "seed"),
            (json!({ "preset": "fast" }), "preset"),
            (json!({ "preset": null }), "preset"),
            (json!({ "without": ["everything"] }), "without"),
            (json!({ "without": "everything" }), "without"),
            (json!({ "with": ["masks"] }), "with"),
            (json!({ "with": "everything" }), "with"),
            (json!({ "rd_curve": [0.001, 0.001] }), "rd_curve"),
            (json!({ "priority": 101 }), "priority"),
            (json!({ "priority": "high" }), "priority"),
            (json!({ "deadline_s": 0 }), "deadline_s"),
            (json!({ "deadline_s": 1e12 }), "deadline_s"),
        ] {
            let fault = read(fields.clone()).expect_err("impossible");
            assert!(fault.contains(&format!("{named}:")), "{fields}: {fault}");
        }
    }
}
