//! Reads the request for a job from a query string or a JSON object, with the same names and meanings in both.

use std::collections::BTreeMap;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Map, Value};

use crate::{
    domain::{
        DatasetId, MAX_NAME, MAX_PRIORITY, Metadata, OptionError, ProblemType, TRAIN_OPTIONS, TrainOption,
        TrainOptions, valid_name,
    },
    engine::checked_options,
    http::{
        problem::{Answer as _, ApiResult, ProblemResponse},
        request::{JsonBody, Parameters, parse_json, whole_numbers},
        state::AppState,
    },
};

/// Longest deadline, in seconds.
const MAX_DEADLINE: u32 = 366 * 24 * 3600;
/// Characters of an unknown name that a problem repeats.
const MAX_SHOWN_NAME: usize = 100;

/// What a job has besides its dataset.
#[derive(Debug, Default)]
pub(crate) struct CreateJobRequest {
    pub(crate) options: TrainOptions,
    pub(crate) priority: i32,
    pub(super) deadline_s: Option<u32>,
    pub(super) name: Option<String>,
    pub(super) metadata: Metadata,
}

impl JsonBody for Map<String, Value> {
    const EXPECTED: &'static str = "an object";
}

impl CreateJobRequest {
    /// Reads a query string.
    pub(crate) fn from_query(mut parameters: Parameters) -> ApiResult<Self> {
        let priority = parameters.take_as("priority", "a whole number")?.unwrap_or(0);
        let deadline_s = parameters.take_as("deadline_s", "a whole number of seconds")?;
        let name = parameters.take("name").map(|name| job_name(&name)).transpose()?;
        let metadata = labels(&mut parameters)?;
        let mut options = TrainOptions::default();
        for (name, text) in parameters.rest() {
            train_option(&name)?.set(&mut options, &text).map_err(|error| invalid_option(&error))?;
        }
        Self { options, priority, deadline_s, name, metadata }.validated()
    }

    /// Reads a JSON object, which also names the dataset.
    pub(crate) fn from_json(content: &[u8]) -> ApiResult<(DatasetId, Self)> {
        let mut object: Map<String, Value> = parse_json(content)?;
        let mut id = |name: &str| {
            let value = object.remove(name);
            value.map(|value| field(name, value, "a dataset's id")).transpose()
        };
        let dataset = one_dataset(id("dataset_id")?, id("scene_id")?)?.ok_or_else(|| {
            ProblemResponse::parameter("dataset_id", "is missing; name the dataset to train on")
        })?;
        let priority = object.remove("priority").map(|value| field("priority", value, "a whole number"));
        let deadline_s = object
            .remove("deadline_s")
            .filter(|value| !value.is_null())
            .map(|value| field("deadline_s", value, "a whole number of seconds"));
        let (priority, deadline_s) = (priority.transpose()?.unwrap_or(0), deadline_s.transpose()?);
        let name = object.remove("name").filter(|value| !value.is_null());
        let name = name.map(|value| job_name(&field::<String>("name", value, "a string")?)).transpose()?;
        let metadata = object.remove("metadata").filter(|value| !value.is_null());
        let metadata = metadata.map(|value| job_labels(field("metadata", value, "an object of strings")?));
        let metadata = metadata.transpose()?.unwrap_or_default();
        let options = options(&object)?;
        Ok((dataset, Self { options, priority, deadline_s, name, metadata }.validated()?))
    }

    fn validated(self) -> ApiResult<Self> {
        if !(-MAX_PRIORITY..=MAX_PRIORITY).contains(&self.priority) {
            let error = format!("{} is outside -{MAX_PRIORITY}..={MAX_PRIORITY}", self.priority);
            return Err(ProblemResponse::parameter("priority", error));
        }
        if let Some(seconds) = self.deadline_s {
            check_deadline(seconds)?;
        }
        Ok(Self { options: possible(self.options)?, ..self })
    }
}

/// Options that may be those of a job.
fn possible(options: TrainOptions) -> ApiResult<TrainOptions> {
    checked_options(options).map_err(|error| invalid_option(&error))
}

/// The name of a job.
fn job_name(name: &str) -> ApiResult<String> {
    let error = || format!("has 1 to {MAX_NAME} characters, none of them a control character");
    valid_name(name).map(str::to_owned).ok_or_else(|| ProblemResponse::parameter("name", error()))
}

/// Takes the labels of a query string, `metadata[KEY]=VALUE` each.
pub(super) fn labels(parameters: &mut Parameters) -> ApiResult<Metadata> {
    job_labels(parameters.take_map("metadata").into_iter().collect())
}

/// Labels of a job.
pub(super) fn job_labels(labels: BTreeMap<String, String>) -> ApiResult<Metadata> {
    Metadata::try_from(labels).map_err(|error| ProblemResponse::parameter("metadata", error))
}

/// A job's name, if it is to have one.
pub(super) fn given_name(name: Option<String>) -> ApiResult<Option<String>> {
    name.map(|name| job_name(&name)).transpose()
}

/// The options of a job with the changes that an object states.
pub(super) fn changed_options(before: &TrainOptions, changes: Map<String, Value>) -> ApiResult<TrainOptions> {
    let whole = serde_json::to_value(before).map_err(|error| ProblemResponse::internal(&error))?;
    let mut fields = match whole {
        Value::Object(fields) => fields,
        _ => Map::new(),
    };
    // Without effect, and refused in requests.
    fields.remove("until");
    if changes.contains_key("plane_compression") {
        // It is stored as one of these.
        fields.remove("with");
        if let Some(Value::Array(without)) = fields.get_mut("without") {
            without.retain(|part| part != "plane-compression");
        }
    }
    fields.extend(changes);
    possible(options(&fields)?)
}

/// The dataset that `dataset_id` and its earlier name, `scene_id`, name.
///
/// # Errors
/// 422 if they name two.
pub(super) fn one_dataset(
    dataset: Option<DatasetId>,
    scene: Option<DatasetId>,
) -> ApiResult<Option<DatasetId>> {
    if dataset.is_some() && scene.is_some() && dataset != scene {
        return Err(ProblemResponse::parameter("scene_id", "names another dataset than dataset_id"));
    }
    Ok(dataset.or(scene))
}

fn field<T: serde::de::DeserializeOwned>(name: &str, mut value: Value, expected: &str) -> ApiResult<T> {
    whole_numbers(&mut value);
    serde_json::from_value(value.clone())
        .map_err(|_| ProblemResponse::parameter(name, format!("{value} is not {expected}")))
}

/// Training options in an object's fields.
fn options(fields: &Map<String, Value>) -> ApiResult<TrainOptions> {
    let mut options = TrainOptions::default();
    for (name, value) in fields {
        let mut value = value.clone();
        whole_numbers(&mut value);
        train_option(name)?.set_json(&mut options, &value).map_err(|error| invalid_option(&error))?;
    }
    Ok(options)
}

/// The training option of a name; 422 if there is none.
fn train_option(name: &str) -> ApiResult<&'static TrainOption> {
    TrainOption::named(name).ok_or_else(|| {
        let shown: String = name.chars().take(MAX_SHOWN_NAME).collect();
        let known = TRAIN_OPTIONS.each_ref().map(|row| row.name).join(", ");
        let detail =
            format!("{shown}: is not an option; there are priority, deadline_s, name, metadata, {known}");
        ProblemType::InvalidOption.because(detail)
    })
}

fn invalid_option(error: &OptionError) -> ProblemResponse {
    ProblemType::InvalidOption.because(error.to_string())
}

/// 422 for a deadline out of range.
pub(super) fn check_deadline(seconds: u32) -> ApiResult<()> {
    if (1..=MAX_DEADLINE).contains(&seconds) {
        return Ok(());
    }
    Err(ProblemResponse::parameter("deadline_s", format!("{seconds} is outside 1..={MAX_DEADLINE}")))
}

/// The deadline that is `seconds` from now.
pub(crate) async fn deadline(state: &AppState, seconds: Option<u32>) -> ApiResult<Option<Timestamp>> {
    let Some(seconds) = seconds else { return Ok(None) };
    let now = state.store().time().await?;
    Ok(now.checked_add(SignedDuration::from_secs(seconds.into())).ok())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const SCENE: &str = "019364d3-0000-7000-8000-000000000001";

    fn read(mut fields: Value) -> Result<CreateJobRequest, String> {
        fields["scene_id"] = json!(SCENE);
        let read = CreateJobRequest::from_json(&serde_json::to_vec(&fields).expect("JSON"));
        read.map(|(_, request)| request).map_err(|error| format!("{error:?}"))
    }

    #[test]
    fn a_dataset_is_named_by_either_name() {
        let other = SCENE.replace('1', "2");
        let named = |fields: Value| {
            let read = CreateJobRequest::from_json(&serde_json::to_vec(&fields).expect("JSON"));
            read.map(|(dataset, _)| dataset.to_string()).map_err(|error| format!("{error:?}"))
        };
        for fields in [
            json!({ "dataset_id": SCENE }),
            json!({ "scene_id": SCENE }),
            json!({ "dataset_id": SCENE, "scene_id": SCENE }),
        ] {
            assert_eq!(named(fields).expect("a request"), SCENE);
        }
        let two = named(json!({ "dataset_id": SCENE, "scene_id": other })).expect_err("two datasets");
        assert!(two.contains("another dataset than dataset_id"), "{two}");
        let none = named(json!({ "preset": "preview" })).expect_err("no dataset");
        assert!(none.contains("dataset_id") && none.contains("is missing"), "{none}");
    }

    #[test]
    fn an_object_means_what_the_query_string_means() {
        let query = "preset=standard&iterations=7&seed=3&background=white&without=masks,wavelet&voxel=0.5&\
                     plane_compression=on&\
                     rd_curve=0.004,1e-3&priority=-5&deadline_s=60";
        let query =
            CreateJobRequest::from_query(Parameters::parse(Some(query)).expect("a query")).expect("possible");
        for (without, with, rd_curve) in [
            (json!(["masks", "wavelet"]), json!(["plane-compression"]), json!([0.004, 0.001])),
            (json!("masks,wavelet"), json!("plane-compression"), json!("0.004,1e-3")),
        ] {
            let object = read(json!({
                "preset": "standard", "iterations": 7.0, "seed": 3, "background": "white", "without": without,
                "with": with, "voxel": 0.5, "rd_curve": rd_curve, "priority": -5, "deadline_s": 60, "lambda": null,
            }))
            .expect("possible");
            assert_eq!(object.options, query.options);
            assert_eq!((object.priority, object.deadline_s), (query.priority, query.deadline_s));
        }
        let absent = read(json!({ "deadline_s": null, "name": null, "metadata": null })).expect("possible");
        assert_eq!((absent.deadline_s, absent.name), (None, None));
        assert_eq!(absent.metadata, Metadata::default());
        let largest =
            read(json!({ "priority": MAX_PRIORITY, "deadline_s": MAX_DEADLINE })).expect("possible");
        assert_eq!((largest.priority, largest.deadline_s), (MAX_PRIORITY, Some(MAX_DEADLINE)));
    }

    #[test]
    fn changes_leave_the_other_options_as_they_are() {
        let before = json!({
            "preset": "standard", "seed": 3, "lambda": 0.004, "without": ["masks"], "voxel": 0.5, "exposure": "on",
            "plane_compression": "on", "skip_missing": true, "masks": "alpha",
        });
        let before = read(before).expect("possible").options;
        let change = |changes: Value| {
            let Value::Object(changes) = changes else { panic!("an object") };
            changed_options(&before, changes).map_err(|error| format!("{error:?}"))
        };
        assert_eq!(change(json!({})), Ok(before.clone()));
        assert_eq!(
            change(json!({ "lambda": 0.002 })),
            Ok(TrainOptions { lambda: Some(0.002), ..before.clone() })
        );
        let reset = change(json!({ "lambda": null, "without": [], "seed": 0 })).expect("possible");
        assert_eq!((reset.lambda, reset.without.len(), reset.seed), (None, 0, 0));
        let off = change(json!({ "plane_compression": "off" })).expect("possible");
        assert_eq!((off.with.len(), off.without.len()), (0, 2));
        let auto = change(json!({ "plane_compression": "auto" })).expect("possible");
        assert_eq!((auto.with.len(), auto.without.len()), (0, 1));
        assert!(
            change(json!({ "rd_curve": [0.001, 0.002] })).expect_err("not with lambda").contains("lambda")
        );
        assert!(change(json!({ "iteratons": 7 })).expect_err("no option").contains("iteratons: is not"));
        assert!(change(json!({ "seed": 1_u64 << 53 })).expect_err("too large").contains("seed"));
    }

    #[test]
    fn who_mistypes_a_name_is_told_which_there_are() {
        let query = Parameters::parse(Some("iteratons=7")).expect("a query");
        let query = CreateJobRequest::from_query(query).expect_err("no such option");
        for error in [format!("{query:?}"), read(json!({ "iteratons": 7 })).expect_err("no such option")] {
            for named in ["iteratons: is not", "deadline_s, name, metadata, preset, iterations,", "rd_curve"]
            {
                assert!(error.contains(named), "{error}");
            }
        }
        let long = read(json!({ "x".repeat(5000): 1 })).expect_err("no such option");
        assert!(long.len() < 1000);
    }

    /// The largest seed.
    const MAX_SEED: u64 = 9_007_199_254_740_991;

    #[test]
    fn seeds_are_taken_as_far_as_every_language_s_json_is_exact() {
        let largest = read(json!({ "seed": MAX_SEED })).expect("a job");
        assert_eq!(
            (largest.options.seed, MAX_SEED),
            (9_007_199_254_740_991, (1_u64 << f64::MANTISSA_DIGITS) - 1)
        );
        let query = Parameters::parse(Some("seed=18446744073709551615")).expect("a query");
        let error = format!("{:?}", CreateJobRequest::from_query(query).expect_err("too large"));
        assert!(
            error.contains("seed: '18446744073709551615' is not a whole number in 0..=9007199254740991"),
            "{error}"
        );
    }

    #[test]
    fn faults_name_their_field() {
        for (fields, named) in [
            (json!({ "color": "red" }), "color"),
            (json!({ "iterations": "7" }), "iterations"),
            (json!({ "iterations": 0 }), "iterations"),
            (json!({ "seed": -1 }), "seed"),
            (json!({ "seed": (1_u64 << 53) }), "seed"),
            (json!({ "seed": -1 }), "seed: '-1' is not a whole number in 0..=9007199254740991"),
            (json!({ "preset": "fast" }), "preset"),
            (json!({ "preset": null }), "preset"),
            (json!({ "without": ["everything"] }), "without"),
            (json!({ "without": "everything" }), "without"),
            (json!({ "with": ["masks"] }), "with"),
            (json!({ "with": "everything" }), "with"),
            (json!({ "plane_compression": true }), "plane_compression"),
            (json!({ "plane_compression": "on", "model": "3dgs" }), "plane_compression"),
            (json!({ "rd_curve": [0.001, 0.001] }), "rd_curve"),
            (json!({ "priority": 101 }), "priority"),
            (json!({ "priority": "high" }), "priority"),
            (json!({ "deadline_s": 0 }), "deadline_s"),
            (json!({ "deadline_s": 1e12 }), "deadline_s"),
            (json!({ "deadline_s": MAX_DEADLINE + 1 }), "deadline_s"),
        ] {
            let error = read(fields.clone()).expect_err("impossible");
            assert!(error.contains(named) && error.contains(':'), "{fields}: {error}");
        }
    }
}
