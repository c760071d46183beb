//! The training options of `openapi.yaml` are those of the table that the command line and the service read them by.

use std::{collections::BTreeSet, fs};

use serde_json::{Value, json};
use tcgs::domain::{TRAIN_OPTIONS, TrainOption, options::OptionKind};

/// Parameters of a job that are no training options.
const OF_THE_QUEUE: [&str; 6] = ["dataset_id", "scene_id", "priority", "deadline_s", "name", "metadata"];

/// JSON readers with 64-bit floats alone have no larger integers, so the API takes none.
const LARGEST_IN_JSON: u64 = (1 << 53) - 1;

/// The schema of one value. Lists have one in JSON only: in the query they are text.
fn schema(kind: OptionKind) -> Value {
    let positive = json!({ "type": "number", "exclusiveMinimum": 0 });
    match kind {
        OptionKind::Choice(names) => json!({ "enum": names }),
        OptionKind::ChoiceOrFolder(_) => {
            let part = r"[^/\\?*.\x00-\x1f\x7f-\x9f][^/\\?*\x00-\x1f\x7f-\x9f]*";
            let pattern = format!("^{part}(/{part})*/?$");
            json!({ "type": "string", "minLength": 1, "maxLength": 200, "pattern": pattern })
        }
        OptionKind::ChoiceOrBox(names) => {
            let number = "[+-]?([0-9]+([.][0-9]*)?|[.][0-9]+)([eE][+-]?[0-9]+)?";
            let pattern = format!("^({}|{number}(,{number}){{5}})$", names.join("|"));
            json!({ "type": "string", "pattern": pattern })
        }
        OptionKind::Choices(names) => json!({ "type": "array", "items": { "enum": names } }),
        OptionKind::Integer(least, most) => {
            let mut schema = json!({ "type": "integer", "minimum": least });
            if most < u64::MAX || least == 0 {
                schema["maximum"] = most.min(LARGEST_IN_JSON).into();
            }
            schema
        }
        OptionKind::Bytes => json!({ "type": "integer", "minimum": 1 }),
        OptionKind::Positive => positive,
        OptionKind::Positives(most) => {
            json!({ "type": "array", "maxItems": most, "uniqueItems": true, "items": positive })
        }
        OptionKind::Switch => json!({ "type": "boolean" }),
        OptionKind::ChoiceOrPositive(names) => json!({ "anyOf": [{ "enum": names }, positive] }),
    }
}

fn in_query(row: &TrainOption) -> Value {
    match row.kind {
        OptionKind::Choices(_) | OptionKind::Positives(_) => json!({ "type": "string" }),
        kind => schema(kind),
    }
}

fn in_json(row: &TrainOption) -> Value {
    let mut schema = schema(row.kind);
    match row.kind {
        OptionKind::Choices(_) | OptionKind::Positives(_) => {
            json!({ "anyOf": [schema, { "type": "string" }] })
        }
        _ => {
            if row.is_nullable() {
                schema["type"] = json!([schema["type"], "null"]);
            }
            if let Some(text) = row.default {
                let text_alone = || text.into();
                schema["default"] = match row.kind {
                    OptionKind::Choice(_) => text_alone(),
                    _ => serde_json::from_str(text).unwrap_or_else(|_| text_alone()),
                };
            }
            schema
        }
    }
}

/// A schema without what is for readers.
fn bare(schema: &Value) -> Value {
    let mut schema = schema.clone();
    for note in ["description", "deprecated", "examples"] {
        schema.as_object_mut().expect("a schema").remove(note);
    }
    schema
}

#[test]
fn the_contract_has_every_option_with_its_values_and_bounds() {
    let text =
        fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml")).expect("the contract");
    let contract: Value = yaml_serde::from_str(&text).expect("YAML");
    let parameters = contract["paths"]["/v1/jobs"]["post"]["parameters"].as_array().expect("parameters");
    let properties =
        contract["components"]["schemas"]["JobRequest"]["properties"].as_object().expect("fields");
    let names: BTreeSet<&str> = TRAIN_OPTIONS.iter().map(|row| row.name).collect();

    for row in &TRAIN_OPTIONS {
        let parameter = parameters.iter().find(|parameter| parameter["name"] == row.name).expect(row.name);
        assert_eq!(bare(&parameter["schema"]), in_query(row), "{} in the query", row.name);
        assert_eq!(bare(&properties[row.name]), in_json(row), "{} in JSON", row.name);
        assert_eq!(parameter["deprecated"] == true, row.help.is_none(), "{}", row.name);
    }
    let queried = parameters.iter().filter(|parameter| parameter["in"] == "query");
    let queried: BTreeSet<&str> =
        queried.map(|parameter| parameter["name"].as_str().expect("a name")).collect();
    let others: BTreeSet<&str> = OF_THE_QUEUE.into();
    assert_eq!(queried.difference(&others).copied().collect::<BTreeSet<_>>(), names);
    let fields: BTreeSet<&str> = properties.keys().map(String::as_str).collect();
    assert_eq!(fields.difference(&others).copied().collect::<BTreeSet<_>>(), names);
}
