//! Settings of a service from flags, environment and a TOML file, in this order of precedence, and their sources.
//!
//! A setting is declared once, as a flag: its name in the file is the flag's with underscores, and the flag's parser, variable and default
//! apply. Every command that takes a file reads the settings that it knows; a name that no command knows is refused.
//! A setting whose flag hides its variable's value (`hide_env_values`) is a secret and is never printed.

use std::{
    ffi::OsString,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use clap::{Arg, ArgAction, ArgMatches, Command, builder::OsStr as ClapStr, parser::ValueSource};
use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{CliError, Report, notice::notice, variables};

/// The commands whose settings may come from a file.
const COMMANDS: [&str; 3] = ["serve", "worker", "viewer"];

/// The flags of the settings file.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct ConfigFlags {
    /// TOML file with settings, named as the flags with underscores (`max_connections = 100`); flags and environment take precedence
    #[arg(long, value_name = "FILE", env = "TCGS_CONFIG")]
    config: Option<PathBuf>,

    /// Print the effective settings as TOML, with the source of each, and exit
    #[arg(long)]
    pub(crate) print_config: bool,
}

/// One setting of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Entry {
    name: String,
    line: usize,
    values: Vec<String>,
}

/// Parsed arguments and the file's settings.
#[derive(Debug)]
pub(crate) struct Settings {
    /// All values, with those of the file as defaults.
    pub(crate) matches: ArgMatches,
    /// As it was declared; settings are printed in this order.
    command: Command,
    file: Option<(PathBuf, Vec<Entry>)>,
}

/// Parses arguments, and if they name a file, again with its settings as defaults.
///
/// # Errors
/// [`CliError::Usage`] for a file that cannot be read or has unknown settings. Wrong arguments end the process, as clap does.
pub(crate) fn parse(
    command: Command,
    arguments: impl IntoIterator<Item = OsString>,
) -> Result<Settings, CliError> {
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let matches = matched(command.clone(), &arguments);
    let file = matches
        .subcommand()
        .filter(|(name, _)| COMMANDS.contains(name))
        .and_then(|(_, given)| given.get_one::<PathBuf>("config").cloned());
    let Some(path) = file else { return Ok(Settings { matches, command, file: None }) };
    let entries = read(&path, &command)?;
    let matches = matched(with_defaults(command.clone(), &entries), &arguments);
    Ok(Settings { matches, command, file: Some((path, entries)) })
}

/// The parsed arguments. Wrong ones end the process; if their value is a variable's, that is said first.
fn matched(command: Command, arguments: &[OsString]) -> ArgMatches {
    command.clone().try_get_matches_from(arguments).unwrap_or_else(|error| {
        if let Some(variable) = variables::refused(&error, &command, arguments) {
            notice(format!("the value is that of the environment variable {variable}"));
        }
        error.exit()
    })
}

impl Settings {
    /// The settings of the command in force as TOML, each with its source.
    pub(crate) fn printed(&self) -> Report {
        let Some((name, matches)) = self.matches.subcommand() else { return Report::default() };
        let Some(command) = self.command.find_subcommand(name) else { return Report::default() };
        let mut text = format!("# Settings of `tcgs {name}`.\n");
        for argument in command.get_arguments().filter(|argument| is_setting(argument)) {
            self.print_one(argument, matches, &mut text);
        }
        Report::text(text)
    }

    fn print_one(&self, argument: &Arg, matches: &ArgMatches, text: &mut String) {
        let name = key(argument);
        let values: Vec<String> = matches
            .get_raw(argument.get_id().as_str())
            .into_iter()
            .flatten()
            .map(|value| value.to_string_lossy().into_owned())
            .collect();
        // Writing into a string cannot fail.
        let _ = if values.is_empty() {
            writeln!(text, "# {name} is not set")
        } else {
            let source = self.source(argument, matches.value_source(argument.get_id().as_str()));
            let shown = if argument.is_hide_env_values_set() {
                "\"(secret)\"".to_owned()
            } else {
                toml_value(argument, &values)
            };
            writeln!(text, "{name} = {shown}  # {source}")
        };
    }

    fn source(&self, argument: &Arg, source: Option<ValueSource>) -> String {
        match source {
            Some(ValueSource::CommandLine) => "flag".to_owned(),
            Some(ValueSource::EnvVariable) => {
                let variable = argument.get_env().unwrap_or_default();
                format!("environment, {}", variable.to_string_lossy())
            }
            _ => {
                let name = key(argument);
                let entry = self.file.iter().find_map(|(path, entries)| {
                    Some((path, entries.iter().find(|entry| entry.name == name)?))
                });
                match entry {
                    Some((path, entry)) => format!("{}, line {}", path.display(), entry.line),
                    None => "default".to_owned(),
                }
            }
        }
    }
}

/// The name of a setting in the file.
fn key(argument: &Arg) -> String {
    argument.get_long().unwrap_or_default().replace('-', "_")
}

/// Excludes hidden flags, which are internal, actions (help, version) and the flags of the file itself.
fn is_setting(argument: &Arg) -> bool {
    let own = matches!(argument.get_id().as_str(), "config" | "print_config");
    let sets = matches!(
        argument.get_action(),
        ArgAction::Set | ArgAction::Append | ArgAction::SetTrue | ArgAction::SetFalse
    );
    argument.get_long().is_some() && !argument.is_hide_set() && !own && sets
}

fn toml_value(argument: &Arg, values: &[String]) -> String {
    let one = |value: &String| {
        let bare = value.parse::<i64>().is_ok() || matches!(value.as_str(), "true" | "false");
        // A JSON string is a TOML string too.
        if bare { value.clone() } else { serde_json::Value::from(value.as_str()).to_string() }
    };
    match (values, argument.get_action()) {
        ([value], ArgAction::Set | ArgAction::SetTrue | ArgAction::SetFalse) => one(value),
        (values, _) => format!("[{}]", values.iter().map(one).collect::<Vec<_>>().join(", ")),
    }
}

fn read(path: &Path, command: &Command) -> Result<Vec<Entry>, CliError> {
    let invalid = |line: Option<usize>, reason: &str| {
        let place = line.map_or_else(String::new, |line| format!(", line {line}"));
        CliError::Usage(format!("--config: {}{place}: {reason}", path.display()))
    };
    let text = fs::read_to_string(path).map_err(|error| invalid(None, &error.to_string()))?;
    let line_at = |start: usize| 1 + text.bytes().take(start).filter(|byte| *byte == b'\n').count();
    let table = DeTable::parse(&text)
        .map_err(|error| invalid(error.span().map(|span| line_at(span.start)), error.message()))?;
    let mut entries = Vec::new();
    for (name, value) in table.into_inner() {
        let line = line_at(name.span().start);
        let name = name.into_inner().into_owned();
        let values = texts(&value).map_err(|error| invalid(Some(line), &format!("{name}: {error}")))?;
        let entry = Entry { name, line, values };
        check(command, &entry).map_err(|error| invalid(Some(line), &error))?;
        entries.push(entry);
    }
    Ok(entries)
}

/// A value as it would be typed.
fn texts(value: &Spanned<DeValue<'_>>) -> Result<Vec<String>, String> {
    Ok(vec![match value.get_ref() {
        DeValue::String(text) => text.to_string(),
        DeValue::Boolean(value) => value.to_string(),
        DeValue::Integer(number) => i64::from_str_radix(number.as_str(), number.radix())
            .map_err(|_| format!("{} is too large", number.as_str()))?
            .to_string(),
        DeValue::Float(number) => number.as_str().to_owned(),
        DeValue::Array(values) => {
            let each = values.iter().map(texts).collect::<Result<Vec<_>, _>>()?;
            return Ok(each.concat());
        }
        DeValue::Datetime(_) | DeValue::Table(_) => {
            return Err(format!("a {} is not a setting's value", value.get_ref().type_str()));
        }
    }])
}

/// Whether some command has such a setting and takes its value.
fn check(command: &Command, entry: &Entry) -> Result<(), String> {
    let of = |name| {
        let command = command.find_subcommand(name)?;
        let argument =
            command.get_arguments().find(|argument| is_setting(argument) && key(argument) == entry.name)?;
        Some((name, argument))
    };
    let Some((command_name, argument)) = COMMANDS.into_iter().find_map(of) else {
        return Err(format!("there is no setting '{}'; `tcgs serve --help` lists the flags", entry.name));
    };
    // A flag without a value is not in what is typed if it is off.
    let flag = argument.get_long().unwrap_or_default();
    let is_switch = matches!(argument.get_action(), ArgAction::SetTrue | ArgAction::SetFalse);
    if is_switch {
        let error = || format!("{}: a switch is true or false", entry.name);
        return entry
            .values
            .iter()
            .all(|value| value.parse::<bool>().is_ok())
            .then_some(())
            .ok_or_else(error);
    }
    let typed = entry.values.iter().map(|value| format!("--{flag}={value}"));
    let trial = [command.get_name().to_owned(), command_name.to_owned()].into_iter().chain(typed);
    command.clone().try_get_matches_from(trial).map(drop).map_err(|error| {
        let text = error.to_string();
        let first = text.lines().next().unwrap_or_default();
        format!("{}: {}", entry.name, first.trim_start_matches("error: "))
    })
}

fn with_defaults(mut command: Command, entries: &[Entry]) -> Command {
    for name in COMMANDS {
        if command.find_subcommand(name).is_none() {
            continue;
        }
        command = command.mut_subcommand(name, |mut subcommand| {
            let settings: Vec<(clap::Id, String)> = subcommand
                .get_arguments()
                .filter(|argument| is_setting(argument))
                .map(|argument| (argument.get_id().clone(), key(argument)))
                .collect();
            for (id, key) in settings {
                let Some(entry) = entries.iter().find(|entry| entry.name == key) else { continue };
                let values = entry.values.iter().map(|value| ClapStr::from(OsString::from(value)));
                let values: Vec<ClapStr> = values.collect();
                subcommand = subcommand.mut_arg(id, |argument| argument.default_values(values));
            }
            subcommand
        });
    }
    command
}

#[cfg(test)]
mod tests {
    use super::*;

    fn command() -> Command {
        let flag = |name: &'static str| Arg::new(name).long(name);
        let serve = Command::new("serve")
            .arg(flag("config").value_parser(clap::value_parser!(PathBuf)))
            .arg(flag("print_config").action(ArgAction::SetTrue))
            .arg(flag("max-things").value_parser(clap::value_parser!(u16)).default_value("7"))
            .arg(flag("place").default_value("here"))
            .arg(flag("name").action(ArgAction::Append))
            .arg(flag("loud").action(ArgAction::SetTrue))
            .arg(flag("token").hide_env_values(true))
            .arg(flag("inner").hide(true));
        let worker = Command::new("worker").arg(flag("place")).arg(flag("alone"));
        Command::new("tcgs").subcommand(serve).subcommand(worker)
    }

    fn parsed(file: &str, more: &[&str]) -> Result<String, CliError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("c.toml");
        fs::write(&path, file).expect("written");
        let arguments = ["tcgs", "serve", "--config"].map(OsString::from).into_iter();
        let arguments = arguments.chain([path.clone().into()]).chain(more.iter().map(OsString::from));
        let printed = parse(command(), arguments)?.printed().text;
        Ok(printed.replace(&path.display().to_string(), "FILE"))
    }

    #[test]
    fn the_file_stands_between_flags_and_defaults_and_sources_are_told() {
        let file =
            "# mine\nmax_things = 3\nname = [\"a\", \"b\"]\nloud = true\ntoken = \"hush\"\nalone = 1\n";
        let printed = parsed(file, &["--place", "there \"now\""]).expect("settings");
        assert_eq!(
            printed.trim_end(),
            "# Settings of `tcgs serve`.\nmax_things = 3  # FILE, line 2\nplace = \"there \\\"now\\\"\"  # flag\n\
             name = [\"a\", \"b\"]  # FILE, line 3\nloud = true  # FILE, line 4\ntoken = \"(secret)\"  # FILE, line 5"
        );
        let outranked = parsed(file, &["--max-things", "9", "--name", "c"]).expect("settings");
        assert!(outranked.contains("max_things = 9  # flag") && outranked.contains("name = [\"c\"]  # flag"));
        let bare = parsed("", &[]).expect("settings");
        assert!(bare.contains("max_things = 7  # default") && bare.contains("# token is not set"), "{bare}");
        assert!(!bare.contains("inner") && !bare.contains("config"), "{bare}");
    }

    #[test]
    fn what_is_printed_is_a_file_that_says_the_same() {
        let printed = parsed("max_things = 0x10\nplace = \"C:\\\\x\"\n", &["--loud"]).expect("settings");
        let again = parsed(&printed, &[]).expect("it is a file");
        let values = |text: &str| -> Vec<String> {
            text.lines().map(|line| line.split("  #").next().unwrap_or_default().to_owned()).collect()
        };
        assert_eq!(values(&printed), values(&again));
        assert!(printed.contains("max_things = 16 "));
    }

    #[test]
    fn what_is_not_a_setting_or_not_its_value_is_refused_with_its_line() {
        for (file, line, named) in [
            ("\nmax_thing = 3", 2, "max_thing"),
            ("inner = 3", 1, "inner"),
            ("config = \"x\"", 1, "config"),
            ("place = \"x\"\n\nmax_things = \"many\"", 3, "max_things: invalid value 'many'"),
            ("max_things = 70000", 1, "max_things: "),
            ("max_things = [1, 2]", 1, "max_things: "),
            ("loud = \"very\"", 1, "loud: "),
            ("[serve]\nplace = \"x\"", 1, "serve: a table"),
            ("place = 1979-05-27", 1, "place: a datetime"),
            ("place = \"x\"\nplace = \"y\"", 2, "duplicate"),
            ("place = ", 1, ""),
        ] {
            let Err(CliError::Usage(error)) = parsed(file, &[]) else { panic!("{file} was taken") };
            assert!(error.contains(&format!("line {line}: ")) && error.contains(named), "{file}: {error}");
        }
        let missing = parse(command(), ["tcgs", "serve", "--config", "/nowhere.toml"].map(OsString::from));
        assert!(matches!(missing, Err(CliError::Usage(error)) if error.contains("/nowhere.toml")));
    }
}
