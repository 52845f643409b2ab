# The whole chain on one campaign, one rule for each step. After a change of a run file only the steps that depend on it
# are repeated. Called by `make run`, which sets BALANCE, PYTHON, CAMPAIGN, GEOMETRY and RESULTS.

ifneq ($(words $(CAMPAIGN)) $(words $(RESULTS)),1 1)
$(error make cannot handle a space in CAMPAIGN=$(CAMPAIGN) or RESULTS=$(RESULTS): use a folder without one)
endif
ifeq ($(wildcard $(CAMPAIGN)/.),)
$(error there is no folder CAMPAIGN=$(CAMPAIGN))
endif
RUNS := $(sort $(wildcard $(CAMPAIGN)/*.h5))
ifeq ($(RUNS),)
$(error there is no run file (*.h5) in CAMPAIGN=$(CAMPAIGN))
endif

R := $(RESULTS)
INPUTS := $(GEOMETRY) $(RUNS)
# The list of inputs is stored with the results, so that another campaign, a new file or a removed one is noticed.
$(shell mkdir -p $(R); echo '$(INPUTS)' | cmp -s - $(R)/inputs.txt || echo '$(INPUTS)' > $(R)/inputs.txt)

# The runs of each kind: STATIC, SWEEP, CHECK, WIND and ZERO. A step depends on the lists of the runs that it uses.
include $(R)/kinds.mk

ROTOR := $(CHECK) $(WIND)
zero := $(if $(ZERO),--zero $(firstword $(ZERO)))
rotor_lists := $(R)/check.list $(R)/wind.list $(R)/zero.list
rig := $(R)/geometry.list
sweeps := $(rig) $(R)/sweep.list
measured := $(sweeps) $(R)/static.list
CAL := $(if $(STATIC),$(R)/calibration.h5)
TF := $(if $(SWEEP),$(R)/transfer.h5)
FITTED := rigid paper paper-full closed
MODELS := $(R)/model-computed.h5 $(if $(SWEEP),$(FITTED:%=$(R)/model-%.h5))
DIAGNOSIS := $(if $(SWEEP),$(R)/diagnosis.h5)
BY := computed $(if $(STATIC),static) $(if $(SWEEP),transfer $(FITTED))
REDUCED := $(and $(STATIC),$(ROTOR),yes)
LOADS := $(if $(REDUCED),$(BY:%=$(R)/loads-%.h5))
SMOOTHED := $(and $(STATIC),$(SWEEP),$(WIND),$(R)/loads-smoother.h5)

.DELETE_ON_ERROR:
.PHONY: all
all: $(R)/modes.json $(R)/report.html $(if $(and $(REDUCED),$(TF)),$(R)/loads.csv $(R)/loads-transfer.csv)
	@$(if $(STATIC),,echo "no static run: no calibration, so no loads")
	@$(if $(SWEEP),,echo "no sweep: no frequency response, and no model is identified")
	@$(if $(ROTOR),,echo "no check or wind run: nothing to reduce")

# Files with faults are named here. Files that cannot be used are left out now, channels that cannot be used later.
$(R)/kinds.mk: $(INPUTS) $(R)/inputs.txt
	-$(BALANCE) check -g $(GEOMETRY) $(INPUTS) --json $(R)/check.json
	$(PYTHON) tools/kinds.py $(R)/check.json

$(R)/%.list: $(R)/kinds.mk ;

$(R)/modes.json: $(rig)
	$(BALANCE) modes -g $(GEOMETRY) --json $@

$(R)/calibration.h5: $(rig) $(R)/static.list
	$(BALANCE) calibrate -g $(GEOMETRY) $(STATIC) -o $@ --json $(@:.h5=.json)

$(R)/transfer.h5: $(sweeps)
	$(BALANCE) sweep-tf -g $(GEOMETRY) $(SWEEP) -o $@ --json $(@:.h5=.json)

$(R)/model-computed.h5: $(measured)
	$(BALANCE) identify -g $(GEOMETRY) $(STATIC) $(SWEEP) --method computed -o $@ --json $(@:.h5=.json)

$(R)/model-rigid.h5: $(measured)
	$(BALANCE) identify -g $(GEOMETRY) $(STATIC) $(SWEEP) -o $@ --json $(@:.h5=.json)

$(R)/model-paper.h5: $(sweeps)
	$(BALANCE) identify -g $(GEOMETRY) $(SWEEP) --form paper -o $@ --json $(@:.h5=.json)

$(R)/model-paper-full.h5: $(sweeps)
	$(BALANCE) identify -g $(GEOMETRY) $(SWEEP) --form paper --damping full -o $@ --json $(@:.h5=.json)

# Model updating, from the rigid model. The check runs are held out: they only measure the errors before and after.
$(R)/diagnosis.h5 $(R)/model-closed.h5 &: $(R)/model-rigid.h5 $(measured) $(R)/check.list
	$(BALANCE) diagnose $(R)/model-rigid.h5 $(STATIC) $(SWEEP) $(CHECK:%=--hold-out %) \
		-o $(R)/diagnosis.h5 --model-out $(R)/model-closed.h5 --json $(R)/diagnosis.json

$(R)/loads-static.h5: $(CAL) $(rotor_lists)
	$(BALANCE) reduce --calibration $(CAL) --static $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

$(R)/loads-transfer.h5: $(CAL) $(TF) $(rotor_lists)
	$(BALANCE) reduce --calibration $(CAL) --transfer $(TF) $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

$(R)/loads-%.h5: $(R)/model-%.h5 $(CAL) $(rotor_lists)
	$(BALANCE) reduce --calibration $(CAL) --model $< $(ROTOR) $(zero) -o $@ --json $(@:.h5=.json)

# Wind-on loads in time by the updated model, for the report and as load histories.
$(R)/loads-smoother.h5: $(R)/model-closed.h5 $(CAL) $(R)/wind.list $(R)/zero.list
	$(BALANCE) reduce --calibration $(CAL) --model $< --method smoother $(WIND) $(zero) \
		--history $(R)/histories -o $@ --json $(@:.h5=.json)

# Load tables by the updated model and by the measured response. Where the residual test flags one, compare the other.
$(R)/loads.csv: $(R)/model-closed.h5 $(CAL) $(rotor_lists)
	$(BALANCE) reduce --calibration $(CAL) --model $< $(ROTOR) $(zero) -o $@

$(R)/loads-transfer.csv: $(CAL) $(TF) $(rotor_lists)
	$(BALANCE) reduce --calibration $(CAL) --transfer $(TF) $(ROTOR) $(zero) -o $@

$(R)/report.html: $(CAL) $(TF) $(MODELS) $(DIAGNOSIS) $(LOADS) $(SMOOTHED)
	$(BALANCE) report $^ -o $@
