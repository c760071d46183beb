//! Help: the commands in groups, and an example of each.

use clap::Command;

/// A group's title, and its commands with an example each.
type Group = (&'static str, &'static [(&'static str, &'static str)]);

const GROUPS: [Group; 5] = [
    (
        "Make a scene",
        &[
            ("sample", "tcgs sample scene.zip"),
            ("poses", "tcgs poses photographs/ -o scene"),
            ("check", "tcgs check scene.zip"),
            ("train", "tcgs train scene.zip -o scene.tcgs --iterations 400"),
        ],
    ),
    (
        "Look at a scene",
        &[
            ("render", "tcgs render scene.tcgs --dataset scene.zip --frame images/view_06.png -o view.png"),
            ("eval", "tcgs eval scene.tcgs scene.zip --save out/"),
            ("inspect", "tcgs inspect scene.tcgs"),
            ("export", "tcgs export scene.tcgs --format html -o scene.html --dataset scene.zip"),
            ("decode", "tcgs decode scene.tcgs -o scene.safetensors"),
            ("encode", "tcgs encode scene.safetensors -o scene.tcgs"),
        ],
    ),
    (
        "Use a service",
        &[
            ("submit", "tcgs submit scene.zip --iterations 400 --wait"),
            ("jobs", "tcgs jobs"),
            ("watch", "tcgs watch JOB"),
            ("fetch", "tcgs fetch JOB -o scene.tcgs"),
            ("view", "tcgs view JOB -o view.png"),
            ("cancel", "tcgs cancel JOB"),
            ("retry", "tcgs retry JOB --set lambda=0.002"),
            ("delete", "tcgs delete JOB"),
        ],
    ),
    (
        "Run a service",
        &[
            ("serve", "tcgs serve --data tcgs-data"),
            ("worker", "tcgs worker --data tcgs-data"),
            ("viewer", "tcgs viewer --data tcgs-data"),
            ("keys", "tcgs keys create --name laptop --data tcgs-data"),
            ("projects", "tcgs projects list --data tcgs-data"),
            ("migrate", "tcgs migrate --data tcgs-data"),
            ("backup", "tcgs backup tcgs-copy --data tcgs-data"),
            ("restore", "tcgs restore tcgs-copy --data tcgs-data"),
            ("fsck", "tcgs fsck --data tcgs-data"),
        ],
    ),
    ("Know this machine", &[("doctor", "tcgs doctor"), ("bench", "tcgs bench accuracy")]),
];

/// The command with its help arranged: groups in place of one list, and an example at the end of each command's own.
pub(super) fn arranged(command: Command) -> Command {
    let mut list = String::new();
    for (title, commands) in GROUPS {
        list.push_str(&format!("{title}:\n"));
        for (name, _) in commands {
            let about = command.find_subcommand(name).and_then(Command::get_about);
            list.push_str(&format!("  {name:<9} {}\n", about.map(ToString::to_string).unwrap_or_default()));
        }
        list.push('\n');
    }
    let template = format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n\n{list}Options:\n{{options}}{{after-help}}"
    );
    let examples = GROUPS.into_iter().flat_map(|(_, commands)| commands);
    examples.fold(command.help_template(template), |command, (name, example)| {
        command.mut_subcommand(name, |sub| {
            let more = sub.get_after_help().map(|text| format!("\n\n{text}")).unwrap_or_default();
            sub.after_help(format!("Example:\n  {example}{more}"))
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use clap::CommandFactory as _;

    use super::*;
    use crate::cli::Cli;

    #[test]
    fn every_command_is_in_one_group() {
        let known: BTreeSet<_> =
            Cli::command().get_subcommands().map(|sub| sub.get_name().to_owned()).collect();
        let grouped: Vec<_> =
            GROUPS.iter().flat_map(|(_, commands)| *commands).map(|(name, _)| *name).collect();
        assert_eq!(grouped.len(), known.len());
        assert!(grouped.iter().all(|name| known.contains(*name)), "{grouped:?}");
    }

    #[test]
    fn examples_are_commands_that_there_are() {
        for (name, example) in GROUPS.iter().flat_map(|(_, commands)| *commands) {
            let words = example.replace("JOB", "01a20055-454e-788e-bcc5-854572fb30d3");
            let parsed = arranged(Cli::command()).try_get_matches_from(words.split_whitespace());
            let matches = parsed.unwrap_or_else(|error| panic!("{example}: {error}"));
            assert_eq!(matches.subcommand_name(), Some(*name));
        }
    }

    #[test]
    fn the_list_is_grouped_and_each_command_ends_with_its_example() {
        let help = arranged(Cli::command()).render_help().to_string();
        assert!(help.contains("Make a scene:\n  sample    "), "{help}");
        assert!(!help.contains("Commands:"), "{help}");
        let own =
            arranged(Cli::command()).find_subcommand_mut("train").expect("it").render_long_help().to_string();
        assert!(own.contains("Example:\n  tcgs train scene.zip"), "{own}");
    }
}
