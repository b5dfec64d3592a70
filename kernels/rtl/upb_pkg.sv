// upb_pkg: what the core is built for. Both headers are written by `upbeam export --to rtl`; nothing here is typed by hand.
//   upb_params.svh  the model: rules, shifts, contract, CRC-32
//   upb_config.svh  the configuration: LANES, FOLD, and the weights in the order of its schedule
package upb_pkg;
    `include "upb_params.svh"
    `include "upb_config.svh"
endpackage
