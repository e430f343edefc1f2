"""Groups of vehicles: what the clients ask, blocking and with asyncio, and what they
make of the answers."""

import asyncio

import grpc
import numpy as np
import pytest

import revisit
from conftest import straight
from fake_service import Fault, FakeService, serving
from revisit import BackoffOptions, StreamOptions, v1

QUICK = BackoffOptions(initial=0.01, max=0.05)
UNAVAILABLE = Fault(grpc.StatusCode.UNAVAILABLE, reason="STORE_UNAVAILABLE")
NOT_READY = Fault(grpc.StatusCode.UNAVAILABLE, reason="GROUP_NOT_READY",
                  metadata={"missing": "3", "members": "9"})

PLANAR = v1.Datum(
    datum_id="gate", pose=v1.StatePose(x_meters=12.5, y_meters=-3, heading_radians=1.5),
    covariance=v1.Covariance(form=v1.COVARIANCE_FORM_PLANAR_6,
                             values=[25, 0, 0, 25, 0, 0.25]))
FOUND = v1.Candidate(query=v1.Node(sequence=310), matched=v1.Node(sequence=1072),
                     matched_vehicle="vehicles/shuttle-7")
ENDS = {"query": v1.MemberPose(vehicle="vehicles/shuttle-8", sequence=310),
        "matched": v1.MemberPose(vehicle="vehicles/shuttle-7", sequence=1072)}


class FakeGroups(FakeService):
    """Keeps what it was asked, and answers with what a test says, or with nothing."""

    def __init__(self, *faults):
        super().__init__(*faults)
        self.asked = []
        self.answers = {}

    def _answer(self, method, request, context):
        self._note(context)
        self.asked.append((method, request))
        self._meet(context)
        answer = self.answers.get(method, getattr(v1, f"{method}Response")())
        return answer(request) if callable(answer) else answer


def _handler(method):
    return lambda self, request, context: self._answer(method, request, context)


for _method in ("CreateGroup", "GetGroup", "ListGroups", "UpdateGroup", "DeleteGroup",
                "AddGroupMember", "UpdateGroupMember", "RemoveGroupMember",
                "ListGroupMembers", "AddInterVehicleLoopClosure",
                "ListInterVehicleLoopClosures", "DeleteInterVehicleLoopClosure",
                "RejectInterVehicleCandidate", "ListInterVehicleRejectedCandidates",
                "DeleteInterVehicleRejectedCandidate", "ListFrameTransforms",
                "FindCandidates"):
    setattr(FakeGroups, _method, _handler(_method))


def blocking(address, method, *arguments, **keywords):
    with revisit.Client(address, backoff=QUICK) as client:
        answer = getattr(client, method)(*arguments, **keywords)
        return list(answer) if method.startswith("list_") else answer


def awaited(address, method, *arguments, **keywords):
    async def call():
        async with revisit.aio.Client(address, backoff=QUICK) as client:
            answer = getattr(client, method)(*arguments, **keywords)
            if method.startswith("list_"):
                return [item async for item in answer]
            return await answer

    return asyncio.run(call())


@pytest.fixture(params=[blocking, awaited], ids=["blocking", "asyncio"])
def call(request):
    return request.param


# What is called, and the request that has to come of it.
CALLS = [
    ("create_group", ("depot",), {}, v1.CreateGroupRequest(
        group_id="depot", group=v1.Group())),
    ("create_group", ("groups/site",),
     {"display_name": "North", "fix_bias_meters": 3.0,
      "geodetic_origin": {"latitude_degrees": 48.25, "longitude_degrees": 11.5}},
     v1.CreateGroupRequest(group_id="site", group=v1.Group(
         display_name="North", settings=v1.GroupSettings(
             fix_bias_meters=3.0, geodetic_origin=v1.GeodeticPosition(
                 latitude_degrees=48.25, longitude_degrees=11.5))))),
    ("get_group", ("depot",), {}, v1.GetGroupRequest(name="groups/depot")),
    ("delete_group", ("depot",), {"expected_revision": 7}, v1.DeleteGroupRequest(
        name="groups/depot", expected_revision=7)),
    ("add_group_member", ("depot", "shuttle-7"), {}, v1.AddGroupMemberRequest(
        parent="groups/depot", member=v1.GroupMember(vehicle="vehicles/shuttle-7"))),
    ("add_group_member", ("depot", "vehicles/shuttle-7", PLANAR), {},
     v1.AddGroupMemberRequest(parent="groups/depot", member=v1.GroupMember(
         vehicle="vehicles/shuttle-7", datum=PLANAR))),
    ("update_group_member", ("depot", "vehicles/shuttle-7", PLANAR),
     {"expected_revision": 4}, v1.UpdateGroupMemberRequest(
         expected_revision=4, member=v1.GroupMember(
             name="groups/depot/members/shuttle-7", datum=PLANAR))),
    ("update_group_member", ("depot", "shuttle-7", None), {},
     v1.UpdateGroupMemberRequest(member=v1.GroupMember(
         name="groups/depot/members/shuttle-7"))),
    ("remove_group_member", ("depot", "shuttle-7"), {}, v1.RemoveGroupMemberRequest(
        name="groups/depot/members/shuttle-7")),
    ("add_inter_vehicle_loop_closure",
     ("depot", ("shuttle-8", 310), ("vehicles/shuttle-7", 1072)),
     {"relative": (1.25, -0.5, 0.03), "covariance": np.diag([4.0, 4.0, 1.0]),
      "score": 0.75, "note": "icp", "loop_closure_id": "first"},
     v1.AddInterVehicleLoopClosureRequest(
         parent="groups/depot", loop_closure_id="first",
         loop_closure=v1.InterVehicleLoopClosure(
             **ENDS, note="icp", score=0.75, measurement=v1.LoopClosureMeasurement(
                 x_meters=1.25, y_meters=-0.5, heading_radians=0.03,
                 covariance=v1.Covariance(form=v1.COVARIANCE_FORM_PLANAR_6,
                                          values=[4, 0, 0, 4, 0, 1]))))),
    ("add_inter_vehicle_loop_closure", ("depot", "shuttle-8", FOUND), {},
     v1.AddInterVehicleLoopClosureRequest(
         parent="groups/depot", loop_closure=v1.InterVehicleLoopClosure(**ENDS))),
    ("delete_inter_vehicle_loop_closure", ("groups/depot/loopClosures/1",), {},
     v1.DeleteInterVehicleLoopClosureRequest(name="groups/depot/loopClosures/1")),
    ("find_candidates", ("shuttle-8",),
     {"group": "depot", "vehicles": ["shuttle-7", "vehicles/shuttle-9"],
      "exclude_own": True, "allow_partial": True, "direction": "either"},
     v1.FindCandidatesRequest(vehicle="vehicles/shuttle-8", options=v1.CandidateOptions(
         direction=v1.DIRECTION_EITHER, scope=v1.SearchScope(
             group="groups/depot", exclude_own=True, allow_partial=True,
             vehicles=["vehicles/shuttle-7", "vehicles/shuttle-9"])))),
    ("find_candidates", ("shuttle-8", 310, v1.CandidateOptions(max_candidates=3)),
     {"group": "groups/depot", "vehicles": "shuttle-7"},
     v1.FindCandidatesRequest(
         vehicle="vehicles/shuttle-8", sequence=310, options=v1.CandidateOptions(
             max_candidates=3, scope=v1.SearchScope(
                 group="groups/depot", vehicles=["vehicles/shuttle-7"])))),
    ("find_candidates", ("shuttle-8",), {}, v1.FindCandidatesRequest(
        vehicle="vehicles/shuttle-8")),
]


@pytest.mark.parametrize("method, arguments, keywords, request_of_it", CALLS,
                         ids=[f"{row[0]}-{number}" for number, row in enumerate(CALLS)])
def test_a_call_asks_what_its_arguments_say(call, method, arguments, keywords,
                                            request_of_it):
    fake = FakeGroups()
    with serving(fake) as address:
        call(address, method, *arguments, **keywords)
    assert [request for _, request in fake.asked] == [request_of_it]


def test_an_update_names_what_is_given_and_nothing_else(call):
    fake = FakeGroups()
    with serving(fake) as address:
        call(address, "update_group", "depot", fix_bias_meters=5.0, display_name="",
             expected_revision=3)
        call(address, "update_group", "depot", geodetic_origin=None)
        call(address, "update_group", "depot", v1.GroupSettings(fix_bias_meters=1.0),
             ["fix_bias_meters"])
    first, second, third = (request for _, request in fake.asked)
    assert first.update_mask.paths == ["settings.fix_bias_meters", "display_name"]
    assert (first.group.settings.fix_bias_meters, first.expected_revision) == (5.0, 3)
    assert second.update_mask.paths == ["settings.geodetic_origin"]
    assert not second.group.settings.HasField("geodetic_origin")
    assert third.update_mask.paths == ["settings.fix_bias_meters"]
    assert third.group.settings.fix_bias_meters == 1.0


def test_answers_are_the_messages_that_they_hold(call):
    fake = FakeGroups()
    group = v1.Group(name="groups/depot", revision=7)
    for method in ("CreateGroup", "GetGroup", "UpdateGroup"):
        fake.answers[method] = getattr(v1, f"{method}Response")(group=group)
    fake.answers["AddGroupMember"] = v1.AddGroupMemberResponse(revision=8)
    with serving(fake) as address:
        assert call(address, "create_group", "depot") == group
        assert call(address, "get_group", "depot") == group
        assert call(address, "update_group", "depot", fix_bias_meters=0.0) == group
        assert call(address, "add_group_member", "depot", "a").revision == 8
        for method, *arguments in (
                ("delete_group", "depot"), ("remove_group_member", "depot", "a"),
                ("delete_inter_vehicle_loop_closure", "groups/depot/loopClosures/1")):
            assert call(address, method, *arguments) is None


@pytest.mark.parametrize("method, arguments, field, kind", [
    ("list_groups", (), "groups", v1.Group),
    ("list_group_members", ("depot",), "members", v1.GroupMember),
    ("list_inter_vehicle_loop_closures", ("depot",), "loop_closures",
     v1.InterVehicleLoopClosure),
    ("list_inter_vehicle_rejected_candidates", ("depot",), "rejected_candidates",
     v1.InterVehicleRejectedCandidate)])
def test_lists_have_all_pages_also_behind_an_empty_one(call, method, arguments, field,
                                                       kind):
    rpc = "".join(word.capitalize() for word in method.split("_"))

    def page(request):
        names, token = {"": (["a", "b"], "2"), "2": ([], "3"), "3": (["c"], "")}[
            request.page_token]
        return getattr(v1, f"{rpc}Response")(
            next_page_token=token, **{field: [kind(name=name) for name in names]})

    fake = FakeGroups()
    fake.answers[rpc] = page
    with serving(fake) as address:
        listed = call(address, method, *arguments)
    assert [item.name for item in listed] == ["a", "b", "c"]
    if arguments:
        assert {request.parent for _, request in fake.asked} == {"groups/depot"}


def test_a_candidate_in_another_vehicle_is_rejected_by_its_poses(call):
    found = v1.Candidate(matched_vehicle="vehicles/b", query=v1.Node(sequence=7),
                         matched=v1.Node(sequence=3))
    fake = FakeGroups()
    with serving(fake) as address:
        for query, matched in ((("a", 7), ("b", 3)), ("a", found)):
            call(address, "reject_inter_vehicle_candidate", "depot", query, matched,
                 note="other hall", rejected_candidate_id="x")
        with pytest.raises(ValueError, match="reject_candidate"):
            call(address, "reject_inter_vehicle_candidate", "depot", "a",
                 v1.Candidate())
    wanted = v1.RejectInterVehicleCandidateRequest(
        parent="groups/depot", rejected_candidate_id="x",
        rejected_candidate=v1.InterVehicleRejectedCandidate(
            query=v1.MemberPose(vehicle="vehicles/a", sequence=7),
            matched=v1.MemberPose(vehicle="vehicles/b", sequence=3),
            note="other hall"))
    assert [request for _, request in fake.asked] == [wanted, wanted]


def frame_pages(*revisions):
    """Answers of ListFrameTransforms: the tenth recording comes after the second."""
    names = {"": ["vehicles/a/recordings/2", "vehicles/a/recordings/10"],
             "2": ["vehicles/a-b/recordings/1", "vehicles/b/recordings/1"]}

    def page(request):
        token = request.page_token
        return v1.ListFrameTransformsResponse(
            next_page_token="" if token else "2",
            group_revision=revisions[1 if token else 0],
            frame_transforms=[v1.FrameTransform(recording=name)
                              for name in names[token]])
    return page


def test_frames_are_listed_over_all_pages_of_one_revision(call):
    fake = FakeGroups(*[NOT_READY] * 3)
    fake.answers["ListFrameTransforms"] = frame_pages(7, 7)
    with serving(fake) as address:
        listed = call(address, "list_frame_transforms", "depot", "a", vehicles="b",
                      allow_partial=True)
        fake.answers["ListFrameTransforms"] = frame_pages(7, 8)
        with pytest.raises(revisit.Aborted, match="changed while"):
            call(address, "list_frame_transforms", "depot", "a")
    assert [one.recording.removeprefix("vehicles/") for one in listed] == [
        "a/recordings/2", "a/recordings/10", "a-b/recordings/1", "b/recordings/1"]
    _, asked = fake.asked[0]
    assert asked == v1.ListFrameTransformsRequest(
        parent="groups/depot", vehicle="vehicles/a", vehicles=["vehicles/b"],
        allow_partial=True, page_size=1000)


def test_a_search_waits_for_the_histories_of_a_group_until_its_deadline(call):
    fake = FakeGroups(*[NOT_READY] * 20)
    fake.answers["FindCandidates"] = v1.FindCandidatesResponse(
        candidates=v1.CandidateSet(group_revision=7))
    with serving(fake) as address:
        assert call(address, "find_candidates", "a", group="g").group_revision == 7
    assert len(fake.asked) == 21


def test_a_group_that_will_not_be_ready_in_time_is_told():
    fake = FakeGroups(Fault(grpc.StatusCode.UNAVAILABLE, reason="GROUP_NOT_READY",
                            retry=120.0))
    with serving(fake) as address:
        with pytest.raises(revisit.Unavailable) as caught:
            blocking(address, "find_candidates", "a", group="g")
    assert caught.value.reason == "GROUP_NOT_READY"
    assert len(fake.asked) == 1


@pytest.mark.parametrize("method, arguments", [
    ("update_group", ("g",)), ("delete_group", ("g",)),
    ("update_group_member", ("g", "a", None)), ("remove_group_member", ("g", "a")),
    ("delete_inter_vehicle_loop_closure", ("groups/g/loopClosures/1",)),
    ("delete_inter_vehicle_rejected_candidate",
     ("groups/g/rejectedCandidates/1",))])
def test_what_may_undo_a_change_by_others_is_never_repeated(call, method, arguments):
    fake = FakeGroups(UNAVAILABLE)
    with serving(fake) as address:
        with pytest.raises(revisit.Unavailable):
            call(address, method, *arguments)
    assert len(fake.asked) == 1


@pytest.mark.parametrize("method, arguments", [
    ("create_group", ("g",)), ("get_group", ("g",)), ("list_groups", ()),
    ("add_group_member", ("g", "a")), ("list_group_members", ("g",)),
    ("add_inter_vehicle_loop_closure", ("g", ("a", 1), ("b", 2))),
    ("list_inter_vehicle_loop_closures", ("g",)),
    ("reject_inter_vehicle_candidate", ("g", ("a", 1), ("b", 2))),
    ("list_inter_vehicle_rejected_candidates", ("g",)),
    ("list_frame_transforms", ("g", "a"))])
def test_what_is_answered_the_same_again_is_repeated(call, method, arguments):
    fake = FakeGroups(UNAVAILABLE)
    with serving(fake) as address:
        call(address, method, *arguments)
    assert len(fake.asked) == 2


@pytest.mark.parametrize("method, arguments", [
    ("update_group", ("g",)), ("delete_group", ("g",)),
    ("add_group_member", ("g", "a")), ("update_group_member", ("g", "a", None)),
    ("remove_group_member", ("g", "a")),
    ("add_inter_vehicle_loop_closure", ("g", ("a", 1), ("b", 2))),
    ("reject_inter_vehicle_candidate", ("g", ("a", 1), ("b", 2))),
    ("delete_inter_vehicle_loop_closure", ("groups/g/loopClosures/1",)),
    ("delete_inter_vehicle_rejected_candidate", ("groups/g/rejectedCandidates/1",))])
def test_a_change_that_lost_to_others_is_made_again(call, method, arguments):
    lost = Fault(grpc.StatusCode.ABORTED, reason="REVISION_MISMATCH")
    fake = FakeGroups(lost, lost)
    with serving(fake) as address:
        call(address, method, *arguments)
    assert len(fake.asked) == 3
    if method in ("update_group", "delete_group", "update_group_member"):
        # One for a revision is not.
        fake = FakeGroups(lost)
        with serving(fake) as address, pytest.raises(revisit.Aborted):
            call(address, method, *arguments, expected_revision=3)
        assert len(fake.asked) == 1


def test_what_only_a_group_has_is_refused_without_one(call):
    fake = FakeGroups()
    with serving(fake) as address:
        for keywords in ({"vehicles": []}, {"exclude_own": True},
                         {"allow_partial": True}):
            with pytest.raises(TypeError, match="group is missing"):
                call(address, "find_candidates", "a", **keywords)
    assert fake.asked == []


class FakeStreams(FakeService):
    """Refuses to open a stream with each of the faults that it is given."""

    def StreamPoses(self, requests, context):
        if self.faults:
            self._note(context)
            self.opens.append(next(requests).open)
            self._meet(context)
        yield from super().StreamPoses(requests, context)


def stream(call, address, **options):
    """Streams a few poses; answers how often it connected again."""
    options = StreamOptions(send_candidates=True, backoff=QUICK, **options)
    if call is blocking:
        with revisit.Client(address) as client:
            with client.stream_poses("a", options) as poses:
                poses.append(straight(3))
            return poses.reconnects

    async def all_poses():
        async with revisit.aio.Client(address) as client:
            async with client.stream_poses("a", options) as poses:
                await poses.append(straight(3))
            return poses.reconnects

    return asyncio.run(all_poses())


def test_a_stream_searches_in_a_group_as_a_call_does(call):
    fake = FakeStreams()
    with serving(fake) as address:
        stream(call, address, group="depot", vehicles=["b", "vehicles/c"],
               exclude_own=True, allow_partial=True,
               candidate_options=v1.CandidateOptions(max_candidates=3))
        stream(call, address, candidate_options=v1.CandidateOptions(max_candidates=3))
    assert [opening.candidate_options for opening in fake.opens] == [
        v1.CandidateOptions(max_candidates=3, scope=v1.SearchScope(
            group="groups/depot", vehicles=["vehicles/b", "vehicles/c"],
            exclude_own=True, allow_partial=True)),
        v1.CandidateOptions(max_candidates=3)]


def test_a_stream_waits_for_the_histories_of_a_group_before_it_takes_poses(call):
    fake = FakeStreams(*[NOT_READY] * 12)
    with serving(fake) as address:
        assert stream(call, address, group="g") == 12
    assert len(fake.opens) == 13 and fake.stored == [1, 2, 3]
    assert all(opening.candidate_options.scope.group == "groups/g"
               for opening in fake.opens)


def test_options_of_a_stream_say_what_does_not_go_together():
    for keywords in ({"vehicles": []}, {"exclude_own": True}, {"allow_partial": True}):
        with pytest.raises(TypeError, match="group is missing"):
            StreamOptions(send_candidates=True, **keywords)
    with pytest.raises(ValueError, match="without send_candidates"):
        StreamOptions(group="depot")


@pytest.mark.parametrize("pose, covariance, expected", [
    ((12.5, -3, 1.5), np.diag([25, 25, 0.25]), PLANAR),
    ((12.5, -3, 1.5), [25, 0, 0, 25, 0, 0.25], PLANAR),
    ((1, 2, 30, 0.5), np.diag([9, 9, 16, 0.25]), v1.Datum(
        datum_id="gate", pose=v1.StatePose(x_meters=1, y_meters=2, z_meters=30,
                                           heading_radians=0.5),
        covariance=v1.Covariance(form=v1.COVARIANCE_FORM_SPATIAL_10,
                                 values=[9, 0, 0, 0, 9, 0, 0, 16, 0, 0.25]))),
    # A quarter turn to the left.
    ([[0, -1, 12.5], [1, 0, -3], [0, 0, 1]], np.diag([25, 25, 0.25]), v1.Datum(
        datum_id="gate", covariance=PLANAR.covariance, pose=v1.StatePose(
            x_meters=12.5, y_meters=-3, heading_radians=np.pi / 2)))])
def test_a_datum_is_made_of_a_pose_or_a_matrix(pose, covariance, expected):
    assert revisit.datum(pose, covariance, datum_id="gate") == expected


def test_numbers_that_are_no_datum_are_told():
    with pytest.raises(ValueError, match="pose has the shape"):
        revisit.datum((1, 2), np.eye(3))
    with pytest.raises(ValueError, match="covariance has the shape"):
        revisit.datum((1, 2, 3), np.eye(2))


@pytest.mark.parametrize("query, matched, error, words", [
    ("shuttle-8", ("shuttle-7", 1072), TypeError, "expected .vehicle, sequence"),
    (("shuttle-8", 310), FOUND, TypeError, "expected the vehicle that asked"),
    ("shuttle-8", v1.Candidate(), ValueError, "add_loop_closure"),
])
def test_ends_that_do_not_go_together_are_told(call, query, matched, error, words):
    fake = FakeGroups()
    with serving(fake) as address:
        with pytest.raises(error, match=words):
            call(address, "add_inter_vehicle_loop_closure", "depot", query, matched)
    assert fake.asked == []


def test_a_measurement_needs_its_covariance_between_vehicles_too(call):
    fake = FakeGroups()
    with serving(fake) as address:
        for keywords in ({"relative": (1, 2, 3)}, {"covariance": np.eye(3)}):
            with pytest.raises(TypeError):
                call(address, "add_inter_vehicle_loop_closure", "depot", ("a", 1),
                     ("b", 2), **keywords)
    assert fake.asked == []


def test_tables_say_in_which_vehicle_a_match_lies_and_what_was_searched():
    answer = v1.CandidateSet(
        candidates=[FOUND, v1.Candidate()], group_revision=7,
        searched=[v1.SearchedVehicle(vehicle="vehicles/shuttle-7")],
        unsearched=[v1.UnsearchedVehicle(), v1.UnsearchedVehicle()])
    table = revisit.candidate_table([answer])
    assert table["matched_vehicle"].tolist() == ["vehicles/shuttle-7", ""]
    table = revisit.check_table([answer, v1.CandidateSet()])
    assert table["searched"].tolist() == [1, 0]
    assert table["unsearched"].tolist() == [2, 0]
    assert table["group_revision"].tolist() == [7, 0]
