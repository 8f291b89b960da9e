"""What `popgen study init` writes: consent, questions, and instructions that fit how pots cook."""

from __future__ import annotations

from collections.abc import Sequence

from popgen.study.study_definition import Question

CONSENT_TEXT = """\
# Taking part in this study

*Replace this text by the one that your ethics board approved, and give it a version in study.json.*

You will play a cooking game with computer-controlled partners in your browser. It takes about 30
minutes: a few practice games, then games in pairs, each about a minute long, with short questions
after each pair.

**What is recorded.** Your moves in the games with the times of your key presses, and your answers.
Your name, your e-mail address and your network address are not recorded. If you come from a
recruiting platform, its number for you is only used to see that you take part once; what is kept of
it cannot be turned back.

**Your choice.** Taking part is voluntary. You may stop at any time without giving a reason, and you
can have all your records deleted with one button, now or later with your participant code.

**Risks and benefits.** No risks beyond those of a short computer game are known.

**Contact.** *Name and address of the person responsible.*
"""

AGREEMENT = ("strongly disagree", "disagree", "rather disagree", "neither", "rather agree", "agree", "strongly agree")
WITHHELD = "prefer not to say"
BY_ITSELF = "by itself, once three ingredients are in it"
BY_INTERACT = "press Space at a full pot with empty hands"


def list_instructions(cooking: str, seconds: int, end_seconds: float) -> list[str]:
    """Paragraphs for a cooking mode, `auto` or `interact`.

    Args:
        cooking: how a full pot starts.
        seconds: of a game.
        end_seconds: without a key after which a game is void.
    """
    starts = (
        "A pot with three onions cooks by itself."
        if cooking == "auto"
        else ("A pot with three onions starts to cook when somebody with empty hands presses Space at it.")
    )
    return [
        "You and your partner are cooks in one kitchen. Deliver as many soups as you can, together.",
        "Move with the arrow keys. You face the way you moved last. Space takes, puts down or uses what is in front "
        "of you.",
        f"Take onions from a box of onions and put three into a pot. {starts} The number on the pot counts down; a "
        "tick says that the soup is ready.",
        "Take a dish, press Space at the pot to fill it, and bring the soup to the green counter with the arrow.",
        "You can put things down on empty counters and pass them to your partner. Cooks cannot walk through each "
        "other.",
        f"A game takes {seconds} seconds. If you press no key for {end_seconds:g} seconds, the game ends and is "
        "played once more; if that happens again, the study ends for you.",
        "You may reload the page at any time: the game waits and goes on where it was.",
    ]


def list_check(cooking: str) -> tuple[Question, ...]:
    """The comprehension check."""
    right = BY_ITSELF if cooking == "auto" else BY_INTERACT
    return (
        Question(
            key="cooking",
            text="How does a pot begin to cook?",
            options=(BY_ITSELF, BY_INTERACT, "press Space at it with a dish"),
            answer=right,
        ),
        Question(
            key="aim",
            text="What is the aim?",
            options=(
                "to deliver more soups than the partner",
                "to deliver as many soups as possible together",
                "to fill all counters",
            ),
            answer="to deliver as many soups as possible together",
        ),
        Question(
            key="filling",
            text="What do you need to take a soup out of a pot?",
            options=("empty hands", "an onion", "a dish"),
            answer="a dish",
        ),
    )


def list_items() -> tuple[Question, ...]:
    """Items after each pair: seven points, and which partner was better."""
    told = {
        "adapted": "adapted to what I was doing",
        "consistent": "was consistent in what it did",
        "human_like": "acted like a human",
        "in_the_way": "was in my way",
        "frustrating": "was frustrating to play with",
        "enjoyed": "was one I enjoyed playing with",
        "coordinated": "coordinated well with me",
    }
    both = [
        Question(key=f"{key}_{which}", text=f"The {which} partner {text}.", options=AGREEMENT)
        for which in ("first", "second")
        for key, text in told.items()
    ]
    choice = ("the first partner", "the second partner", "no difference")
    return (*both, Question(key="preference", text="Whom would you rather play with again?", options=choice))


def list_demographics() -> tuple[Question, ...]:
    """Questions at the end, as in the paper: gender, age group, experience."""
    ages: Sequence[str] = ("18-25", "26-35", "36-45", "46-55", "56 or more", WITHHELD)
    return (
        Question(key="gender", text="Your gender", options=("woman", "man", "another", WITHHELD)),
        Question(key="age", text="Your age", options=tuple(ages)),
        Question(
            key="experience",
            text="How much experience with video games do you have?",
            options=("none", "a little", "some", "much", "very much", WITHHELD),
        ),
    )
