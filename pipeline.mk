# The whole chain on one campaign, for Makefiles: `make -f pipeline.mk CAMPAIGN=folder RESULTS=folder`. The steps, and
# which of them are to be repeated, are those of `balance run`; `make -n` only prints the call. Further variables:
# GEOMETRY (if it is not in the campaign), JOBS, and BALANCE, the command.

BALANCE ?= balance
JOBS ?= 1
RESULTS ?= results

.PHONY: chain
chain:
	$(BALANCE) run "$(CAMPAIGN)" $(if $(GEOMETRY),-g "$(GEOMETRY)") -o "$(RESULTS)" --jobs $(JOBS)
