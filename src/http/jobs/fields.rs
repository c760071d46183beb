//! `fields`: the part of a job that a client asks for.

use serde_json::{Map, Value};

use super::body::FIELDS;
use crate::http::{
    problem::{ApiResult, ProblemResponse},
    request::Parameters,
};

/// Most fields of one request.
const MAX_FIELDS: usize = 64;

/// Paths of fields, such as `name` and `metrics.test.psnr`; everything without any.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Fields(Option<Vec<String>>);

impl Fields {
    /// Takes `fields`, paths separated by commas.
    ///
    /// # Errors
    /// 422 for a name that no job has.
    pub(super) fn take(parameters: &mut Parameters) -> ApiResult<Self> {
        let Some(text) = parameters.take("fields") else { return Ok(Self(None)) };
        let paths: Vec<String> = text.split(',').map(|path| path.trim().to_owned()).collect();
        if paths.len() > MAX_FIELDS {
            return Err(ProblemResponse::parameter("fields", format!("has more than {MAX_FIELDS} names")));
        }
        for path in &paths {
            let mut names = path.split('.');
            let is_known = names.next().is_some_and(|name| FIELDS.contains(&name));
            if !is_known || names.any(str::is_empty) {
                let shown: String = path.chars().take(100).collect();
                let error = format!("'{shown}' is not a field of a job; there are {}", FIELDS.join(", "));
                return Err(ProblemResponse::parameter("fields", error));
            }
        }
        Ok(Self(Some(paths)))
    }

    /// The value of the parameter, if it was given.
    pub(super) fn text(&self) -> Option<String> {
        self.0.as_ref().map(|paths| paths.join(","))
    }

    /// The fields of `whole` that are asked for. A path that leads nowhere adds nothing.
    pub(super) fn of(&self, whole: Value) -> Value {
        let Some(paths) = &self.0 else { return whole };
        let mut part = Value::Object(Map::new());
        for path in paths {
            let names: Vec<&str> = path.split('.').collect();
            if let Some(found) = names.iter().try_fold(&whole, |value, name| value.get(name)) {
                insert(&mut part, &names, found);
            }
        }
        part
    }
}

/// Puts a value at a path, within the objects that the path names.
fn insert(into: &mut Value, names: &[&str], value: &Value) {
    let Some((first, rest)) = names.split_first() else {
        *into = value.clone();
        return;
    };
    if let Value::Object(fields) = into {
        let field = fields.entry(*first).or_insert_with(|| Value::Object(Map::new()));
        insert(field, rest, value);
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn fields(text: &str) -> Result<Fields, String> {
        let query = format!("fields={text}");
        let mut parameters = Parameters::parse(Some(&query)).expect("a query");
        Fields::take(&mut parameters).map_err(|error| format!("{error:?}"))
    }

    #[test]
    fn a_part_has_the_named_fields_alone() {
        let whole = json!({
            "id": 1, "name": null, "metrics": { "test": { "psnr": 2.0, "per_view": [] }, "steps": 3 },
        });
        let part = |text: &str| fields(text).expect(text).of(whole.clone());
        assert_eq!(part("id,name"), json!({ "id": 1, "name": null }));
        assert_eq!(
            part("metrics.test.psnr, metrics.steps"),
            json!({ "metrics": { "test": { "psnr": 2.0 }, "steps": 3 } })
        );
        assert_eq!(part("metrics.test.psnr,metrics"), json!({ "metrics": whole["metrics"] }));
        assert_eq!(part("metrics,metrics.steps"), json!({ "metrics": whole["metrics"] }));
        assert_eq!(part("name.first,metrics.train.psnr,id.x"), json!({}), "paths that lead nowhere");
        assert_eq!(Fields::default().of(whole.clone()), whole);
    }

    #[test]
    fn names_that_no_job_has_are_refused() {
        for text in ["nmae", "", "id,", "metrics..psnr", ".id"] {
            let error = fields(text).expect_err(text);
            assert!(error.contains("is not a field of a job"), "{error}");
        }
        assert!(fields(&vec!["id"; 65].join(",")).expect_err("too many").contains("64"));
    }
}
