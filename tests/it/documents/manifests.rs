//! Manifests for many machines start what there is, with settings that it reads, without rights that it does not need.

use std::{collections::BTreeMap, fs, time::Duration};

use serde::Deserialize as _;
use serde_json::Value;

use crate::support::{
    program,
    tree::{root, text},
};

const FOLDER: &str = "docker/kubernetes";
const COMPOSE: &str = "docker/compose.machines.yaml";

/// Folders that the program writes to, besides its data folder: photographs beyond a run's memory, and the drivers' runtime files.
const WRITTEN: [&str; 2] = ["/tmp", "/run/tcgs"];

/// Every resource in the folder, with its file.
fn resources() -> Vec<(String, Value)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(root().join(FOLDER)).expect("a folder") {
        let name = entry.expect("an entry").file_name().into_string().expect("UTF-8");
        let file = format!("{FOLDER}/{name}");
        if name != "kustomization.yaml" {
            for document in yaml_serde::Deserializer::from_str(&text(&file)) {
                found.push((file.clone(), Value::deserialize(document).expect("YAML")));
            }
        }
    }
    assert!(found.len() >= 9, "{found:?}");
    found
}

fn of_kind<'a>(resources: &'a [(String, Value)], kind: &str) -> Vec<(&'a str, &'a Value)> {
    let found = resources.iter().filter(|(_, resource)| resource["kind"] == kind);
    found.map(|(file, resource)| (file.as_str(), resource)).collect()
}

fn items(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn strings(value: &Value) -> Vec<&str> {
    items(value).iter().map(|item| item.as_str().expect("a text")).collect()
}

/// The help of a role of the program.
fn help(role: &str) -> String {
    let output = program::command().args([role, "--help"]).output().expect("the binary runs");
    assert!(output.status.success(), "there is no `tcgs {role}`");
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Holds flags and variables of a container to what its role reads; returns the role.
fn assert_starts(arguments: &[&str], variables: &[&str], place: &str) -> String {
    let (role, flags) = arguments.split_first().expect("a role");
    let help = help(role);
    for flag in flags.iter().filter(|word| word.starts_with("--")) {
        let is_there = help.split_whitespace().any(|word| word.trim_end_matches(',') == *flag);
        assert!(is_there, "{place}: `tcgs {role}` has no {flag}");
    }
    for name in variables.iter().filter(|name| name.starts_with("TCGS_")) {
        let is_read = ["=", "]"].iter().any(|end| help.contains(&format!("[env: {name}{end}")));
        assert!(is_read, "{place}: `tcgs {role}` does not read {name}");
    }
    (*role).to_owned()
}

/// How long a role takes to stop at most.
fn time_to_stop(role: &str, arguments: &[&str]) -> Duration {
    let http = tcgs::http::HttpConfig::default();
    let worker = tcgs::worker::WorkerConfig::from_environment();
    let after = |flag: &str| {
        let place = arguments.iter().position(|argument| *argument == flag)?;
        Some(seconds(arguments.get(place + 1).expect("a value")))
    };
    match role {
        "worker" => worker.drain + worker.copy_checkpoints_every,
        _ => after("--drain-notice").unwrap_or(http.drain_notice) + after("--drain").unwrap_or(http.drain),
    }
}

fn seconds(text: &str) -> Duration {
    Duration::from_secs(text.trim_end_matches('s').parse().expect("seconds"))
}

#[test]
fn every_pod_starts_a_role_with_settings_that_there_are_and_time_to_stop() {
    let all = resources();
    let configs: BTreeMap<&str, &Value> = of_kind(&all, "ConfigMap")
        .into_iter()
        .map(|(_, config)| (config["metadata"]["name"].as_str().expect("a name"), &config["data"]))
        .collect();
    let mut roles = Vec::new();
    for (file, deployment) in of_kind(&all, "Deployment") {
        let pod = &deployment["spec"]["template"]["spec"];
        let [container] = items(&pod["containers"]) else { panic!("{file}: one container") };
        let mut variables: Vec<&str> =
            items(&container["env"]).iter().map(|one| one["name"].as_str().expect("a name")).collect();
        for from in items(&container["envFrom"]) {
            let config = configs[from["configMapRef"]["name"].as_str().expect("a name")];
            variables.extend(config.as_object().expect("settings").keys().map(String::as_str));
        }
        for needed in ["TCGS_DATABASE", "TCGS_BLOBS", "TCGS_DATA", "AWS_SECRET_ACCESS_KEY"] {
            assert!(variables.contains(&needed), "{file}: no {needed}");
        }
        let arguments = strings(&container["args"]);
        let role = assert_starts(&arguments, &variables, file);
        let patience = pod["terminationGracePeriodSeconds"].as_u64().expect("a time");
        let needed = time_to_stop(&role, &arguments);
        assert!(Duration::from_secs(patience) > needed, "{file}: {patience} s are too short for {needed:?}");
        roles.push(role);
    }
    roles.sort();
    assert_eq!(roles, ["serve", "viewer", "worker"]);
}

#[test]
fn pods_have_no_rights_that_they_do_not_need_and_folders_for_what_they_write() {
    let all = resources();
    let data = of_kind(&all, "ConfigMap")[0].1["data"]["TCGS_DATA"].as_str().expect("a folder").to_owned();
    for (file, deployment) in of_kind(&all, "Deployment") {
        let pod = &deployment["spec"]["template"]["spec"];
        assert_eq!(pod["securityContext"]["runAsNonRoot"], true, "{file}");
        assert_eq!(pod["automountServiceAccountToken"], false, "{file}");
        let container = &pod["containers"][0];
        let rights = &container["securityContext"];
        assert_eq!(rights["readOnlyRootFilesystem"], true, "{file}");
        assert_eq!(rights["allowPrivilegeEscalation"], false, "{file}");
        assert_eq!(strings(&rights["capabilities"]["drop"]), ["ALL"], "{file}");
        let volumes: Vec<&Value> = items(&pod["volumes"]).iter().map(|volume| &volume["name"]).collect();
        let mounts = items(&container["volumeMounts"]);
        for mount in mounts {
            assert!(volumes.contains(&&mount["name"]), "{file}: there is no volume {}", mount["name"]);
        }
        let paths: Vec<&str> =
            mounts.iter().map(|mount| mount["mountPath"].as_str().expect("a path")).collect();
        for folder in WRITTEN.iter().copied().chain([data.as_str()]) {
            let is_mounted = paths.iter().any(|path| std::path::Path::new(folder).starts_with(path));
            assert!(is_mounted, "{file}: {folder} cannot be written");
        }
        for probe in ["livenessProbe", "readinessProbe", "startupProbe"] {
            let path = &container[probe]["httpGet"]["path"];
            assert!(path.is_null() || path == "/healthz" || path == "/readyz", "{file}: {probe} asks {path}");
        }
    }
}

#[test]
fn secrets_are_only_referred_to() {
    let all = resources();
    assert!(of_kind(&all, "Secret").is_empty(), "a secret belongs in no repository");
    for (file, deployment) in of_kind(&all, "Deployment") {
        for variable in items(&deployment["spec"]["template"]["spec"]["containers"][0]["env"]) {
            let name = variable["name"].as_str().expect("a name");
            let is_secret = name == "TCGS_DATABASE" || name.starts_with("AWS_");
            assert_eq!(is_secret, variable["valueFrom"]["secretKeyRef"].is_object(), "{file}: {name}");
        }
    }
}

#[test]
fn services_and_budgets_select_the_pods_of_one_deployment() {
    let all = resources();
    let deployments = of_kind(&all, "Deployment");
    let labels: Vec<&Value> =
        deployments.iter().map(|(_, one)| &one["spec"]["template"]["metadata"]["labels"]).collect();
    for (file, deployment) in &deployments {
        let selected = &deployment["spec"]["selector"]["matchLabels"];
        assert_eq!(selected, &deployment["spec"]["template"]["metadata"]["labels"], "{file}");
    }
    let budgets = of_kind(&all, "PodDisruptionBudget");
    assert_eq!(budgets.len(), deployments.len(), "every deployment has its budget");
    for (file, budget) in budgets {
        assert!(labels.contains(&&budget["spec"]["selector"]["matchLabels"]), "{file}");
    }
    for (file, service) in of_kind(&all, "Service") {
        let selected = labels.iter().position(|labels| *labels == &service["spec"]["selector"]);
        let (_, deployment) = deployments[selected.unwrap_or_else(|| panic!("{file}: it selects nothing"))];
        let ports = &deployment["spec"]["template"]["spec"]["containers"][0]["ports"];
        for port in items(&service["spec"]["ports"]) {
            let target = &port["targetPort"];
            assert!(items(ports).iter().any(|port| &port["name"] == target), "{file}: no port {target}");
        }
    }
}

/// Fills maps with what they take from others by `<<`.
fn merge(value: &mut Value) {
    if let Some(map) = value.as_object_mut() {
        if let Some(Value::Object(base)) = map.remove("<<") {
            for (key, value) in base {
                map.entry(key).or_insert(value);
            }
        }
        map.values_mut().for_each(merge);
    }
}

#[test]
fn the_compose_file_of_many_machines_starts_each_role_with_settings_that_there_are() {
    let mut compose: Value = yaml_serde::from_str(&text(COMPOSE)).expect("YAML");
    merge(&mut compose);
    let mut roles = Vec::new();
    for (name, service) in compose["services"].as_object().expect("services") {
        if service["image"] != "tcgs" {
            continue;
        }
        let variables = service["environment"].as_object().expect("variables");
        let variables: Vec<&str> = variables.keys().map(String::as_str).collect();
        let arguments = strings(&service["command"]);
        let role = assert_starts(&arguments, &variables, &format!("{COMPOSE}: {name}"));
        let patience = seconds(service["stop_grace_period"].as_str().expect("a time"));
        assert!(patience > time_to_stop(&role, &arguments), "{name}");
        assert_eq!(
            (&service["read_only"], strings(&service["cap_drop"])),
            (&true.into(), vec!["ALL"]),
            "{name}"
        );
        roles.push(role);
    }
    roles.sort();
    assert_eq!(roles, ["serve", "viewer", "worker"]);
}
