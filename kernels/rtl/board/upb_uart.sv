`include "upb_check.svh"
// upb_uart: registers over a serial line (8 data bits, no parity, 1 stop bit): a manager of AXI4-Lite.
//
//   host: 'R' address-low address-high                         answer: response data0 data1 data2 data3 (low byte first)
//   host: 'W' address-low address-high data0 data1 data2 data3  answer: response
//
// response: 0 OKAY, 2 SLVERR. Other bytes where a command is expected are dropped; a command that stops for 2^20 clocks is forgotten.
// DIVIDER: clocks a bit. Latency: the answer begins 4 to 6 clocks after the command's last stop bit was sampled.
module upb_uart #(
    parameter integer DIVIDER = 217
) (
    input  wire        clk,
    input  wire        rst,
    input  wire        rx,
    output wire        tx,

    output reg  [14:0] address,
    output reg         awvalid,
    input  wire        awready,
    output reg  [31:0] wdata,
    output reg         wvalid,
    input  wire        wready,
    input  wire [ 1:0] bresp,
    input  wire        bvalid,
    output reg         arvalid,
    input  wire        arready,
    input  wire [31:0] rdata,
    input  wire [ 1:0] rresp,
    input  wire        rvalid
    // bready and rready are 1: an answer is taken at once.
);
    `UPB_REQUIRE(DIVIDER >= 4 && DIVIDER <= 65535, bad_divider, "upb_uart: DIVIDER must be 4 to 65535 clocks a bit")
    localparam [7:0] READ = 8'h52, WRITE = 8'h57;

    // ------------------------------------------------------------------ a byte in
    reg [2:0] line;                  // synchronised to the clock
    reg [15:0] wait_rx;
    reg [3:0] bits_rx;               // of the byte that comes, its start bit included; 0: none
    reg [7:0] byte_rx;
    reg got;
    always @(posedge clk) begin
        line <= {line[1:0], rx};
        got <= 1'b0;
        if (bits_rx == 4'd0) begin
            if (!line[2]) begin
                bits_rx <= 4'd1;
                wait_rx <= DIVIDER / 2;
            end
        end else if (wait_rx != 16'd0) wait_rx <= wait_rx - 16'd1;
        else begin
            wait_rx <= DIVIDER - 1;
            bits_rx <= bits_rx + 4'd1;
            if (bits_rx == 4'd1) begin
                if (line[2]) bits_rx <= 4'd0;  // no start bit: a glitch
            end else if (bits_rx == 4'd10) begin
                bits_rx <= 4'd0;
                got <= line[2];                // no stop bit: the byte is dropped
            end else byte_rx <= {line[2], byte_rx[7:1]};
        end
        if (rst) begin
            line <= 3'b111;
            bits_rx <= 4'd0;
            got <= 1'b0;
        end
    end

    // ------------------------------------------------------------------ bytes out
    reg [39:0] answer;
    reg [2:0] bytes_left;
    reg [15:0] wait_tx;
    reg [3:0] bits_tx;               // still to send
    reg [9:0] shift_tx;
    assign tx = bits_tx == 4'd0 || shift_tx[0];

    // ------------------------------------------------------------------ commands
    reg [2:0] have;                  // bytes of the command
    reg writes, busy;
    reg [19:0] idle;
    always @(posedge clk) begin
        if (awready) awvalid <= 1'b0;
        if (wready) wvalid <= 1'b0;
        if (arready) arvalid <= 1'b0;

        idle <= got || have == 3'd0 ? 20'd0 : idle + 20'd1;
        if (got && !busy) begin
            have <= have + 3'd1;
            case (have)
                3'd0: begin
                    writes <= byte_rx == WRITE;
                    if (byte_rx != WRITE && byte_rx != READ) have <= 3'd0;
                end
                3'd1: address[7:0] <= byte_rx;
                3'd2: address[14:8] <= byte_rx[6:0];
                default: wdata <= {byte_rx, wdata[31:8]};
            endcase
            if (have == (writes ? 3'd6 : 3'd2) && have != 3'd0) begin
                have <= 3'd0;
                busy <= 1'b1;
                {awvalid, wvalid, arvalid} <= {writes, writes, !writes};
            end
        end else if (idle == 20'hfffff) have <= 3'd0;

        if (busy && (bvalid || rvalid)) begin
            answer <= bvalid ? {38'd0, bresp} : {rdata, 6'd0, rresp};
            bytes_left <= bvalid ? 3'd1 : 3'd5;
        end
        if (bits_tx != 4'd0) begin
            if (wait_tx != 16'd0) wait_tx <= wait_tx - 16'd1;
            else begin
                wait_tx <= DIVIDER - 1;
                shift_tx <= {1'b1, shift_tx[9:1]};
                bits_tx <= bits_tx - 4'd1;
            end
        end else if (bytes_left != 3'd0) begin
            shift_tx <= {1'b1, answer[7:0], 1'b0};
            answer <= {8'd0, answer[39:8]};
            bits_tx <= 4'd10;
            wait_tx <= DIVIDER - 1;
            bytes_left <= bytes_left - 3'd1;
            if (bytes_left == 3'd1) busy <= 1'b0;
        end
        if (rst) begin
            {awvalid, wvalid, arvalid, busy} <= 4'b0000;
            have <= 3'd0;
            bytes_left <= 3'd0;
            bits_tx <= 4'd0;
        end
    end
endmodule
