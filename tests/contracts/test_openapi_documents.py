"""OpenAPI documents of all services: names that generated clients depend on, schemas, examples."""

import re

import pytest
from jsonschema import Draft202012Validator

from dextouch.frozen_model import FrozenModel, attribute_docs, example
from dextouch.schemas import Problem, error_from_problem
from tests.contracts.service_apps import APPS

# Functions of generated clients have these names, so a change breaks programs of others. The rule:
# the name of the route's function, a verb and what it is done to; `list` for GET of many, `get` for
# GET of one thing.
OPERATIONS = {
    "acquisition": """
        get_recorder arm_recorder start_recording stop_recording save_take discard_take
        rerecord_take begin_session get_station_health list_health_events get_health_history
        list_uploads get_upload retry_upload get_live_overview get_live_taxels get_live_poses
        list_cameras get_camera_image get_practice start_practice stop_practice
        set_fault""",
    "alignment": """
        start_alignments list_alignments get_alignment cancel_alignment get_calibration
        start_practice stop_practice start_calibration_run get_calibration_run
        get_calibration_image answer_calibration_run keep_calibration_place
        drop_calibration_place finish_calibration_run cancel_calibration_run""",
    "dashboard": """
        get_heatmap_layout get_overview operate_recorder retry_upload get_camera_image
        start_comparison move_hands stop_comparison get_comparison_chunk get_system
        list_audit_entries""",
    "episode_store": """
        create_recording upload_batch finish_recording get_recording list_uploads expire_uploads
        list_recordings list_episodes get_hours get_hours_by_field list_items
        list_compared_groups list_values get_lineage review_items list_trash delete_items
        restore_items list_episodes_to_click get_clicks_file get_episode_clicks
        save_episode_clicks get_recording_attributes get_recording_samples get_episode
        get_episode_window get_episode_samples get_playback get_playback_images
        get_playback_signals get_playback_robot_hands list_deletions get_deletions_revision
        check_takes confirm_deletions list_enrolments issue_enrolment exchange_enrolment
        revoke_enrolment trim_episode_steps relabel_items list_notes save_note delete_note
        download_items""",
    "rating": """
        get_next_rollout get_step_image submit_mark get_agreement list_invitations invite_rater
        revoke_rater""",
    "studies": "list_studies get_study get_study_picture list_study_rollouts",
    "teleoperation": "stop_hand",
    "worlds": """
        list_worlds start_rollout get_rollout delete_rollout send_chunk fork_rollout
        list_watched_rollouts get_watched_response""",
}
OF_ALL = {"check_liveness", "check_readiness"}
NAME = re.compile(r"[a-z]+(_[a-z]+)+")
JSON, PROBLEM = "application/json", "application/problem+json"


@pytest.fixture(scope="module", params=APPS)
def service(request, tmp_path_factory):
    name = request.param
    return name, APPS[name](tmp_path_factory.mktemp(name)).openapi()


def operations_of(document):
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            yield f"{method.upper()} {path}", operation


def resolved(document, item):
    """What a reference within the document points to."""
    while "$ref" in item:
        reference = item["$ref"]
        item = document
        for part in reference.removeprefix("#/").split("/"):
            item = item[part]
    return item


def test_operation_ids_are_those_that_clients_know(service):
    name, document = service
    named = {operation["operationId"]: where for where, operation in operations_of(document)}
    assert len(named) == len(list(operations_of(document)))
    assert set(named) == {*OPERATIONS[name].split(), *OF_ALL}
    for operation_id, where in named.items():
        assert NAME.fullmatch(operation_id)
        reads = where.startswith("GET ")
        assert reads is operation_id.startswith(("get_", "list_", "check_live", "check_read"))


def test_every_operation_says_what_it_does_takes_and_answers(service):
    _, document = service
    for where, operation in operations_of(document):
        assert operation["summary"], where
        assert operation["description"].strip(), where
        assert operation["tags"], where
        answers = [one for status, one in operation["responses"].items() if int(status) < 300]
        assert answers, where
        bodies = [resolved(document, operation.get("requestBody", {}))]
        for content in (one.get("content", {}) for one in [*answers, *bodies]):
            for kind, media in content.items():
                assert media["schema"], f"{where}: {kind}"


def test_every_json_body_has_a_valid_example(service):
    _, document = service
    for where, operation in operations_of(document):
        media = operation.get("requestBody", {}).get("content", {}).get(JSON)
        if media is None:
            continue
        schema = media["schema"]
        parts = [resolved(document, one) for one in schema.get("anyOf", [schema])]
        examples = [example for part in parts for example in part.get("examples", [])]
        assert examples, where
        validator = Draft202012Validator(schema | {"components": document["components"]})
        for shown in examples:
            validator.validate(shown)


def test_every_refusal_is_a_problem_with_an_example(service):
    _, document = service
    for where, operation in operations_of(document):
        for status, answer in operation["responses"].items():
            if int(status) < 400 or where.endswith("/readyz"):
                continue
            content = resolved(document, answer)["content"][PROBLEM]
            assert content["schema"] == {"$ref": "#/components/schemas/Problem"}
            problem = Problem.model_validate(content["example"])
            assert problem.status == int(status)
            # Clients raise it as an error of its class.
            assert str(error_from_problem(problem)) == problem.detail


def test_references_lead_somewhere(service):
    _, document = service

    def check(item):
        if isinstance(item, dict):
            if isinstance(item.get("$ref"), str):
                resolved(document, item)
            for value in item.values():
                check(value)
        elif isinstance(item, list):
            for value in item:
                check(value)

    check(document)


class Measured(FrozenModel):
    """A measurement.

    Attributes:
        force_n: of the finger,
            perpendicular to the pad.
        at_ns: when.
    """

    model_config = example(force_n=1.0, at_ns=2)

    force_n: float
    at_ns: int
    note: str = ""


def test_docstrings_describe_fields():
    schema = Measured.model_json_schema()
    assert schema["description"] == "A measurement."
    said = {name: field.get("description") for name, field in schema["properties"].items()}
    assert said == {
        "force_n": "Of the finger, perpendicular to the pad.",
        "at_ns": "When.",
        "note": None,
    }
    assert schema["examples"] == [{"force_n": 1.0, "at_ns": 2}]
    assert attribute_docs(Measured)[0] == "A measurement."
