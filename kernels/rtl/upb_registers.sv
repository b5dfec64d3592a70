// upb_registers: the register block of upb_top behind AXI4-Lite. The map is in registers.toml; from it come upb_regs.svh (here),
// runtime/fpga/upb_regs.h and docs/fpga-registers.md.
//
// Watches the core's events and its output stream; holds the core in reset while CONTROL.ENABLE is 0, at least 64 clocks; checks a
// weights image as it is written and asks the core to swap banks at the next frame.
//
// A frame's times are kept in a small ring by its number, since the next frame begins before its last column has left.
// Latency: an event at clock t is in EVENTS and at `irq` at t + 2.
module upb_registers #(
    parameter [127:0] CONTRACT = 128'd0,
    parameter [31:0] MODEL_CRC = 32'd0,
    parameter [31:0] SHAPE = 32'd0,
    parameter [31:0] SCALE_DISTANCE = 32'd0,
    parameter [31:0] SCALE_INTENSITY = 32'd0,
    parameter [31:0] SLOPES = 32'd0,
    parameter [31:0] RING = 32'd0,
    parameter [31:0] CLOCK_HZ = 32'd0,
    parameter [15:0] COLUMNS = 16'd2048,
    parameter integer WRITABLE = 0
) (
    input  wire        clk,
    input  wire        rst,

    input  wire [14:0] s_axil_awaddr,
    input  wire        s_axil_awvalid,
    output wire        s_axil_awready,
    input  wire [31:0] s_axil_wdata,
    input  wire [ 3:0] s_axil_wstrb,
    input  wire        s_axil_wvalid,
    output wire        s_axil_wready,
    output wire [ 1:0] s_axil_bresp,
    output wire        s_axil_bvalid,
    input  wire        s_axil_bready,
    input  wire [14:0] s_axil_araddr,
    input  wire        s_axil_arvalid,
    output wire        s_axil_arready,
    output wire [31:0] s_axil_rdata,
    output wire [ 1:0] s_axil_rresp,
    output wire        s_axil_rvalid,
    input  wire        s_axil_rready,
    output reg         irq,

    output reg         running,          // the core's aresetn
    output reg  [15:0] columns,
    input  wire        ev_column,
    input  wire        ev_frame,
    input  wire        ev_short_column,
    input  wire        ev_long_column,
    input  wire        ev_short_frame,
    input  wire        ev_long_frame,
    input  wire        ev_dropped,
    input  wire        ev_overrun,
    input  wire        out_beat,         // a beat leaves
    input  wire        out_last,
    input  wire        out_starts,
    input  wire        out_waits,        // a beat is offered and not taken

    output reg  [44:0] weights,          // {write, word address[11:0], data}: to the bank that is not in use
    output reg         bank,             // in use
    output reg         swap,             // use the other one from the next frame on
    input  wire        ev_swapped
);
    `include "upb_regs.svh"
    localparam integer RESET_BITS = 6;
    localparam integer TIMES = 8;  // frames whose first beat is in and whose last is not out: at most 3, of one column each 7

    // ------------------------------------------------------------------ the bus
    wire write, read;
    wire [14:0] write_address, read_address;
    wire [31:0] write_data;
    wire [3:0] write_strobe;
    reg  [31:0] read_data;
    reg  read_error, write_error;
    upb_axil #(.ADDRESS(ADDRESS_BITS)) bus (
        .clk(clk), .rst(rst),
        .s_axil_awaddr(s_axil_awaddr), .s_axil_awvalid(s_axil_awvalid), .s_axil_awready(s_axil_awready),
        .s_axil_wdata(s_axil_wdata), .s_axil_wstrb(s_axil_wstrb), .s_axil_wvalid(s_axil_wvalid),
        .s_axil_wready(s_axil_wready), .s_axil_bresp(s_axil_bresp), .s_axil_bvalid(s_axil_bvalid),
        .s_axil_bready(s_axil_bready), .s_axil_araddr(s_axil_araddr), .s_axil_arvalid(s_axil_arvalid),
        .s_axil_arready(s_axil_arready), .s_axil_rdata(s_axil_rdata), .s_axil_rresp(s_axil_rresp),
        .s_axil_rvalid(s_axil_rvalid), .s_axil_rready(s_axil_rready),
        .write(write), .write_address(write_address), .write_data(write_data), .write_strobe(write_strobe),
        .write_error(write_error), .read(read), .read_address(read_address), .read_data(read_data), .read_error(read_error)
    );

    reg enable;
    wire at_weights = write_address[14];
    wire may_load = WRITABLE != 0 && !swap;
    always @* begin
        case (write_address)
            AT_CONTROL, AT_DEADLINE, AT_EVENTS, AT_IRQ_ENABLE: write_error = 1'b0;
            AT_COLUMNS: write_error = enable || write_data[31:16] != 16'd0 || write_data[15:2] == 14'd0;
            AT_WEIGHTS_COMMAND, AT_WEIGHTS_LENGTH, AT_WEIGHTS_EXPECTED, AT_WEIGHTS_MODEL: write_error = !may_load;
            default: write_error = !(at_weights && may_load && write_address[1:0] == 2'b00);
        endcase
        if (write_strobe != 4'b1111) write_error = 1'b1;
    end
    wire put = write && !write_error;

    // ------------------------------------------------------------------ control
    reg [RESET_BITS:0] reset_count;
    reg [31:0] deadline;
    reg [EVENT_BITS-1:0] events, irq_enable;
    wire clear = enable && !running;  // the counters begin with the core
    always @(posedge clk) begin
        if (put && write_address == AT_CONTROL) enable <= write_data[CONTROL_ENABLE];
        if (put && write_address == AT_COLUMNS) columns <= write_data[15:0];
        if (put && write_address == AT_DEADLINE) deadline <= write_data;
        if (put && write_address == AT_IRQ_ENABLE) irq_enable <= write_data[EVENT_BITS-1:0];
        running <= enable && reset_count[RESET_BITS];
        if (!enable) reset_count <= 0;
        else if (!reset_count[RESET_BITS]) reset_count <= reset_count + 1'b1;
        if (rst) begin
            enable <= 1'b0;
            running <= 1'b0;
            reset_count <= 0;
            columns <= COLUMNS;
            deadline <= 32'd0;
            irq_enable <= 0;
        end
    end

    // ------------------------------------------------------------------ counters
    reg [31:0] frames_in, columns_in, frames_out, columns_out, dropped, errors, misses;
    wire frame_done, miss;
    wire error = ev_short_column || ev_long_column || ev_short_frame || ev_long_frame;
    always @(posedge clk) begin
        frames_in <= frames_in + ev_frame;
        columns_in <= columns_in + ev_column;
        frames_out <= frames_out + frame_done;
        columns_out <= columns_out + (out_beat && out_last);
        dropped <= dropped + ev_dropped;
        errors <= errors + error;
        misses <= misses + miss;
        if (rst || clear) {frames_in, columns_in, frames_out, columns_out, dropped, errors, misses} <= {7{32'd0}};
    end

    // ------------------------------------------------------------------ times of a frame
    reg [31:0] now;
    reg [31:0] began[0:TIMES-1];
    reg [31:0] arrived[0:TIMES-1];
    reg [TIMES-1:0] whole;               // its last column has come in
    reg [2:0] in_frame, out_frame;       // the frame that comes in, that goes out
    reg [15:0] in_columns, out_columns;
    reg [31:0] frame_clocks, latency, latency_max;
    wire last_in = ev_column && in_columns + 16'd1 == columns;
    wire [2:0] leaving = out_beat && out_starts ? out_frame + 3'd1 : out_frame;
    wire last_out = out_beat && out_last && out_columns + 16'd1 == columns && whole[out_frame];
    reg done1;
    reg [31:0] began1, arrived1, done_at;
    wire [31:0] latency_now = done_at - arrived1;
    assign frame_done = done1;
    always @(posedge clk) begin
        now <= now + 32'd1;
        if (ev_frame) begin
            in_frame <= in_frame + 3'd1;
            in_columns <= 16'd0;
            began[in_frame + 3'd1] <= now - 32'd1;  // events are a clock late
            whole[in_frame + 3'd1] <= 1'b0;
        end
        if (ev_column) in_columns <= in_columns + 16'd1;
        if (last_in) begin
            arrived[in_frame] <= now - 32'd1;
            whole[in_frame] <= 1'b1;
        end
        out_frame <= leaving;
        if (out_beat && out_starts) out_columns <= 16'd0;
        else if (out_beat && out_last) out_columns <= out_columns + 16'd1;
        done1 <= last_out;
        done_at <= now;
        began1 <= began[out_frame];
        arrived1 <= arrived[out_frame];
        if (done1) begin
            frame_clocks <= done_at - began1;
            latency <= latency_now;
            if (latency_now > latency_max) latency_max <= latency_now;
        end
        if (rst || clear) begin
            {in_frame, out_frame} <= 6'd0;
            {in_columns, out_columns} <= 32'd0;
            whole <= 0;
            done1 <= 1'b0;
            {now, frame_clocks, latency, latency_max} <= {4{32'd0}};
        end
    end

    // ------------------------------------------------------------------ deadline
    // Watches the frame whose last column came in last. The one before it has left by then, unless frames are shorter than what
    // the pipeline holds; if it has not, it has missed.
    reg watching;
    reg [2:0] watched;
    reg [31:0] timer;
    wire expires = watching && deadline != 32'd0 && (timer == deadline || last_in);
    assign miss = expires;
    always @(posedge clk) begin
        timer <= timer + 32'd1;
        if (expires || (last_out && watched == out_frame)) watching <= 1'b0;
        if (last_in) begin
            watching <= 1'b1;
            watched <= in_frame;
            timer <= 32'd0;
        end
        if (rst || !running) watching <= 1'b0;
    end

    // A sink that is stuck from early on holds the last column back at the input, so that no frame is late: a beat is.
    reg [31:0] waited;
    wire stalls = deadline != 32'd0 && out_waits && waited == deadline;
    always @(posedge clk)
        if (rst || !out_waits) waited <= 32'd1;
        else if (waited != 32'hffffffff) waited <= waited + 32'd1;

    // ------------------------------------------------------------------ events
    reg refused;
    wire [EVENT_BITS-1:0] set;
    assign set[EVENTS_FRAME] = frame_done;
    assign set[EVENTS_SWAPPED] = ev_swapped;
    assign set[EVENTS_DEADLINE] = miss;
    assign set[EVENTS_SHORT_COLUMN] = ev_short_column;
    assign set[EVENTS_LONG_COLUMN] = ev_long_column;
    assign set[EVENTS_SHORT_FRAME] = ev_short_frame;
    assign set[EVENTS_LONG_FRAME] = ev_long_frame;
    assign set[EVENTS_DROPPED] = ev_dropped;
    assign set[EVENTS_OVERRUN] = ev_overrun;
    assign set[EVENTS_WEIGHTS] = refused;
    assign set[EVENTS_STALLED] = stalls;
    wire [EVENT_BITS-1:0] cleared = put && write_address == AT_EVENTS ? write_data[EVENT_BITS-1:0] : {EVENT_BITS{1'b0}};
    always @(posedge clk) begin
        // An event that comes while its flag is being cleared stays.
        events <= (events & ~cleared) | set;
        irq <= |(events & irq_enable);
        if (rst) begin
            events <= 0;
            irq <= 1'b0;
        end
    end

    // ------------------------------------------------------------------ weights
    // CRC-32 as zlib's: reflected 04C11DB7, begins and ends inverted.
    function automatic [31:0] crc_of(input [31:0] crc, input [31:0] word);
        integer n;
        begin
            crc_of = crc;
            for (n = 0; n < 32; n = n + 1) crc_of = {1'b0, crc_of[31:1]} ^ (crc_of[0] ^ word[n] ? 32'hedb88320 : 32'd0);
        end
    endfunction

    wire [31:0] weights_sum, weights_crc, model_crc, written, length, expected, model;
    generate
        if (WRITABLE != 0) begin : loading
            reg [31:0] crc, active_crc, active_model, count, length_r, expected_r, model_r;
            reg second;  // of the two words that a write adds to the CRC
            wire load = put && at_weights;
            wire [31:0] offset = {18'd0, write_address[13:0]};
            wire command = put && write_address == AT_WEIGHTS_COMMAND;
            wire begins = command && write_data[WEIGHTS_COMMAND_BEGIN];
            wire sound = count == length_r && ~crc == expected_r;
            wire asked = command && write_data[WEIGHTS_COMMAND_SWAP] && !begins;
            always @(posedge clk) begin
                weights <= {load, write_address[13:2], write_data};
                second <= load;
                if (load || second) crc <= crc_of(crc, second ? weights[31:0] : offset);
                if (load) count <= count + 32'd1;
                if (begins) begin
                    crc <= 32'hffffffff;
                    count <= 32'd0;
                end
                if (put && write_address == AT_WEIGHTS_LENGTH) length_r <= write_data;
                if (put && write_address == AT_WEIGHTS_EXPECTED) expected_r <= write_data;
                if (put && write_address == AT_WEIGHTS_MODEL) model_r <= write_data;
                refused <= asked && !sound;
                if (asked && sound) swap <= 1'b1;
                if (ev_swapped) begin
                    swap <= 1'b0;
                    bank <= !bank;
                    active_crc <= ~crc;
                    active_model <= model_r;
                end
                if (rst) begin
                    weights[44] <= 1'b0;
                    {second, refused, swap, bank} <= 4'b0000;
                    {active_model, active_crc} <= {MODEL_CRC, 32'd0};
                    crc <= 32'hffffffff;
                    {count, length_r, expected_r, model_r} <= {4{32'd0}};
                end
            end
            assign {weights_sum, weights_crc, model_crc} = {~crc, active_crc, active_model};
            assign {written, length, expected, model} = {count, length_r, expected_r, model_r};
        end else begin : baked
            always @(posedge clk) begin
                weights <= 45'd0;
                {refused, swap, bank} <= 3'b000;
            end
            assign {weights_sum, weights_crc, model_crc} = {64'd0, MODEL_CRC};
            assign {written, length, expected, model} = {4{32'd0}};
        end
    endgenerate

    // ------------------------------------------------------------------ reading
    reg [31:0] status;
    always @* begin
        status = 32'd0;
        status[STATUS_RUNNING] = running;
        status[STATUS_SWAP_PENDING] = swap;
        status[STATUS_BANK] = bank;
        status[STATUS_IRQ] = irq;
        read_error = 1'b0;
        case (read_address)
            AT_ID: read_data = ID_VALUE;
            AT_VERSION: read_data = VERSION_VALUE;
            AT_CONTRACT_0: read_data = CONTRACT[127:96];
            AT_CONTRACT_1: read_data = CONTRACT[95:64];
            AT_CONTRACT_2: read_data = CONTRACT[63:32];
            AT_CONTRACT_3: read_data = CONTRACT[31:0];
            AT_MODEL_CRC: read_data = model_crc;
            AT_WEIGHTS_CRC: read_data = weights_crc;
            AT_SHAPE: read_data = SHAPE;
            AT_SCALE_DISTANCE: read_data = SCALE_DISTANCE;
            AT_SCALE_INTENSITY: read_data = SCALE_INTENSITY;
            AT_SLOPES: read_data = SLOPES;
            AT_RING: read_data = RING;
            AT_CLOCK_HZ: read_data = CLOCK_HZ;
            AT_CONTROL: read_data = {31'd0, enable};
            AT_STATUS: read_data = status;
            AT_COLUMNS: read_data = {16'd0, columns};
            AT_DEADLINE: read_data = deadline;
            AT_EVENTS: read_data = {{(32 - EVENT_BITS) {1'b0}}, events};
            AT_IRQ_ENABLE: read_data = {{(32 - EVENT_BITS) {1'b0}}, irq_enable};
            AT_FRAMES_IN: read_data = frames_in;
            AT_COLUMNS_IN: read_data = columns_in;
            AT_FRAMES_OUT: read_data = frames_out;
            AT_COLUMNS_OUT: read_data = columns_out;
            AT_DROPPED: read_data = dropped;
            AT_ERRORS: read_data = errors;
            AT_MISSES: read_data = misses;
            AT_FRAME_CLOCKS: read_data = frame_clocks;
            AT_LATENCY: read_data = latency;
            AT_LATENCY_MAX: read_data = latency_max;
            AT_WEIGHTS_COMMAND: read_data = 32'd0;
            AT_WEIGHTS_WRITTEN: read_data = written;
            AT_WEIGHTS_SUM: read_data = weights_sum;
            AT_WEIGHTS_LENGTH: read_data = length;
            AT_WEIGHTS_EXPECTED: read_data = expected;
            AT_WEIGHTS_MODEL: read_data = model;
            default: begin
                read_data = 32'd0;
                read_error = 1'b1;
            end
        endcase
    end
`ifdef FORMAL
    reg past;
    reg [RESET_BITS:0] enabled_for;
    initial past = 0;
    always @(posedge clk) begin
        past <= 1'b1;
        assume (past || rst);
        if (rst || !enable) enabled_for <= 0;
        else if (!enabled_for[RESET_BITS]) enabled_for <= enabled_for + 1'b1;
        if (past && !rst && $past(!rst)) begin
            long_reset: assert (!running || enabled_for[RESET_BITS] || !enable);
            reset_counts: assert (enabled_for == reset_count);
            stops_at_once: assert (!running || $past(enable));
            // A flag stays until 1 is written to it, and one that comes at the same clock is not lost.
            flags_stay: assert ((events & $past(events & ~cleared)) == $past(events & ~cleared));
            flags_come: assert ((events & $past(set)) == $past(set));
            flags_only_so: assert ((events & ~$past(events | set)) == 0);
            interrupt: assert (irq == $past(|(events & irq_enable)));
            if (!$past(clear)) begin
                counts_dropped: assert (dropped == $past(dropped) + $past(ev_dropped));
                counts_columns: assert (columns_out == $past(columns_out) + $past(out_beat && out_last));
                counts_errors: assert (errors == $past(errors) + $past(error));
                counts_misses: assert (misses == $past(misses) + $past(set[EVENTS_DEADLINE]));
            end else clears: assert (dropped == 0 && columns_out == 0 && errors == 0 && misses == 0);
            if ($past(running && watching && deadline != 0 && timer == deadline && !rst)) deadline_told: assert (events[EVENTS_DEADLINE]);
            columns_fixed: assert (columns == $past(columns) || $past(!enable && put));
            columns_within: assert (columns >= 16'd4);
            bank_with_swap: assert (bank == $past(bank) || $past(ev_swapped));
            swap_waits: assert (!$past(swap && !ev_swapped) || swap);
            no_write_while_waiting: assert (!$past(swap) || !weights[44]);
            sound_swap: assert (!swap || $past(swap) || ($past(written == length && weights_sum == expected)));
        end
    end
`endif
endmodule
