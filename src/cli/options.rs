//! Flags for training options, made from `domain`'s table of them.

use clap::{
    Arg, ArgAction, ArgMatches, Args, Command, Error, FromArgMatches, builder::PossibleValuesParser,
    error::ErrorKind,
};
use tcgs::{
    domain::{Bytes, TRAIN_OPTIONS, TrainOption, TrainOptions, options::OptionKind},
    pipeline::checked_options,
};

use super::CliError;

/// Every option, as `train` and `submit` take them.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct TrainFlags(TrainOptions);

impl TrainFlags {
    fn rows() -> impl Iterator<Item = &'static TrainOption> {
        TRAIN_OPTIONS.iter()
    }

    /// The options, if a run can have them.
    pub(super) fn validated(&self) -> Result<TrainOptions, CliError> {
        Ok(checked_options(self.0.clone())?)
    }
}

impl Args for TrainFlags {
    fn augment_args(command: Command) -> Command {
        Self::rows().map(flag).fold(command, Command::arg)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for TrainFlags {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let mut options = TrainOptions::default();
        for row in Self::rows() {
            let texts: Vec<&str> =
                matches.get_many(row.name).into_iter().flatten().map(String::as_str).collect();
            if !texts.is_empty() {
                row.set(&mut options, &texts.join(","))
                    .map_err(|error| Error::raw(ErrorKind::ValueValidation, error))?;
            }
        }
        Ok(Self(options))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

fn flag(row: &'static TrainOption) -> Arg {
    let flag = Arg::new(row.name)
        .long(row.name.replace('_', "-"))
        .help(row.help.unwrap_or_default())
        .hide(row.help.is_none())
        .allow_negative_numbers(true);
    let flag = match row.default {
        Some(text) => flag.default_value(text),
        None => flag,
    };
    // What is of the right kind may still be out of bounds, which the options' own check says.
    let is_of_kind = move |text: &str| {
        let set = row.set(&mut TrainOptions::default(), text);
        set.map(|()| text.to_owned()).map_err(|error| error.error)
    };
    let list = |flag: Arg| flag.value_name("LIST").value_delimiter(',').action(ArgAction::Append);
    match row.kind {
        // An earlier flag's other values are refused by the options' own check, which has the reason.
        OptionKind::Choice(_) if row.help.is_none() => flag.value_parser(is_of_kind),
        OptionKind::Choice(names) => flag.value_parser(PossibleValuesParser::new(names)),
        OptionKind::Choices(names) => list(flag).value_parser(PossibleValuesParser::new(names)),
        OptionKind::Positives(_) => list(flag).value_parser(is_of_kind),
        OptionKind::Integer(..) => flag.value_name("N").value_parser(is_of_kind),
        OptionKind::Switch => flag
            .value_parser(is_of_kind)
            .num_args(0..=1)
            .require_equals(true)
            .default_missing_value("true")
            .hide_default_value(true)
            .value_name("true|false"),
        OptionKind::Bytes => flag
            .value_name("BYTES")
            .value_parser(move |text: &str| is_of_kind(&text.parse::<Bytes>()?.0.to_string())),
        // A box may begin with a minus.
        OptionKind::ChoiceOrBox(_) => {
            flag.value_name("cameras|BOX").allow_hyphen_values(true).value_parser(is_of_kind)
        }
        OptionKind::Positive | OptionKind::ChoiceOrPositive(_) | OptionKind::ChoiceOrFolder(_) => {
            flag.value_name("X").value_parser(is_of_kind)
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};
    use tcgs::domain::{Background, Component, Preset};

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        flags: TrainFlags,
    }

    fn parse(flags: &[&str]) -> TrainFlags {
        Line::try_parse_from([&["train"], flags].concat()).expect("parses").flags
    }

    #[test]
    fn no_flag_means_the_default_options() {
        assert_eq!(parse(&[]).validated(), Ok(TrainOptions::default()));
    }

    #[test]
    fn flags_become_options_and_impossible_ones_are_wrong_usage() {
        let flags = ["--preset", "standard", "--iterations", "900", "--seed", "7", "--background", "white"];
        let options = parse(&flags).validated().expect("possible");
        assert_eq!(options.preset, Preset::Standard);
        assert_eq!((options.iterations, options.seed), (Some(900), 7));
        assert_eq!(options.background, Background::White);
        let sized = parse(&["--max-bytes", "500kB"]).validated().expect("possible");
        assert_eq!(sized.max_bytes, Some(500_000));
        for text in ["0", "5 pounds", "-1"] {
            assert!(Line::try_parse_from(["train", "--max-bytes", text]).is_err(), "{text}");
        }
        for flags in [["--iterations", "0"], ["--lambda", "0"]] {
            let failure = parse(&flags).validated().expect_err("impossible");
            assert_eq!(failure.exit_status(), 2);
            assert!(failure.to_string().starts_with(flags[0]), "{failure}");
        }
        assert!(Line::try_parse_from(["train", "--preset", "fast"]).is_err());
        assert!(Line::try_parse_from(["train", "--iterations", "many"]).is_err());
        let options = parse(&["--rd-curve", "0.004,0.0005"]).validated().expect("possible");
        assert_eq!(options.rd_curve, [0.004, 0.0005]);
        for wrong in ["0", "-1", "nan", "0.001,0.001"] {
            let failure = parse(&["--rd-curve", wrong]).validated().expect_err("impossible");
            assert!(failure.exit_status() == 2 && failure.to_string().starts_with("--rd-curve"), "{failure}");
        }
        let both = parse(&["--rd-curve", "0.001", "--max-bytes", "9"]).validated();
        assert_eq!(both.expect_err("impossible").exit_status(), 2);
    }

    #[test]
    fn a_flag_of_earlier_versions_is_taken_and_is_not_in_the_help() {
        let error = parse(&["--until", "converged"]).validated().expect_err("no longer a choice");
        assert!(error.to_string().contains("runs no longer end early"), "{error}");
        assert_eq!(parse(&["--until", "full"]).validated(), Ok(TrainOptions::default()));
        let help = Line::command().render_long_help().to_string();
        assert!(help.contains("--iterations") && !help.contains("--until"), "{help}");
    }

    #[test]
    fn planes_are_compressed_by_a_switch_and_the_published_name_of_the_part_still_switches_it_off() {
        let parts = |flags: &[&str]| {
            let options = parse(flags).validated().expect("possible");
            (options.without, options.with)
        };
        let (none, part) = (Default::default(), [Component::PlaneCompression].into());
        assert_eq!(parts(&["--plane-compression", "auto"]), (none, Default::default()));
        assert_eq!(parts(&["--plane-compression", "on"]).1, part);
        assert_eq!(parts(&["--plane-compression", "off"]).0, part);
        assert_eq!(parts(&["--without", "plane-compression"]).0, part);
        let listed = parts(&["--without", "knn,masks", "--without", "wavelet"]).0;
        assert_eq!(listed, [Component::Knn, Component::Masks, Component::Wavelet].into());
        let both = parse(&["--plane-compression", "on", "--without", "plane-compression"]).validated();
        assert!(both.expect_err("a contradiction").to_string().starts_with("--plane-compression"));
    }
}
